-- Fields of LDCN/NMC and SmartStep packets, in captures of `ldcnd bus wire-log --form pcapng` and of any program that
-- writes link type USER0 with the direction of each packet. The tables above are written from those of ldcnd's codecs.

local ldcn = Proto("ldcn", "LDCN/NMC servo network")
local smartstep = Proto("smartstep", "OMRON SmartStep")
local serial = Proto("ldcnd_line", "Servo line")

local comment_of = Field.new("frame.comment")
local SENT, RECEIVED = 0, 1  -- pinfo.p2p_dir

local function has(value, flag)
    return math.floor(value / flag) % 2 == 1
end

-- -- fields ----------------------------------------------------------------------------------------------------------

local function abbreviated(name)
    return (string.gsub(string.lower(name), "[^%w_]", "_"))
end

local fields, listed = {}, {ldcn = {}, smartstep = {}}

local function field(proto, name, make, ...)
    local made = make(proto .. "." .. name, ...)
    fields[proto .. "." .. name] = made
    table.insert(listed[proto], made)
end

local function flag_fields(name, flags)
    field("ldcn", name, ProtoField.uint8, name, base.HEX)
    for _, flag in ipairs(flags) do
        field("ldcn", name .. "." .. abbreviated(flag[2]), ProtoField.bool, flag[2], 8, nil, flag[1])
    end
end

for _, proto in ipairs({"ldcn", "smartstep"}) do
    field(proto, "request", ProtoField.framenum, "Reply to", base.NONE, frametype.REQUEST)
    field(proto, "reply", ProtoField.framenum, "Reply in", base.NONE, frametype.RESPONSE)
    field(proto, "time", ProtoField.double, "Seconds since the request")
    field(proto, "checksum", ProtoField.uint8, "Checksum", base.HEX)
    field(proto, "checksum_ok", ProtoField.bool, "Checksum is right")
    field(proto, "surplus", ProtoField.bytes, "Bytes outside a packet")
end
field("ldcn", "address", ProtoField.uint8, "Address")
field("ldcn", "command", ProtoField.uint8, "Command", base.HEX, COMMANDS)
field("ldcn", "length", ProtoField.uint8, "Data bytes")
field("ldcn", "data", ProtoField.bytes, "Data")
field("ldcn", "dialect", ProtoField.string, "Dialect")
field("ldcn", "new_address", ProtoField.uint8, "New address")
field("ldcn", "group", ProtoField.uint8, "Group address", base.HEX)
field("ldcn", "leader", ProtoField.bool, "Group leader")
field("ldcn", "divisor", ProtoField.uint8, "Baud rate divisor")
field("ldcn", "position", ProtoField.int32, "POSITION")
field("ldcn", "velocity", ProtoField.int32, "VELOCITY")
field("ldcn", "acceleration", ProtoField.uint32, "ACCELERATION")
field("ldcn", "pwm_or_target", ProtoField.uint16, "PWM or analog target")
field("ldcn", "adc", ProtoField.uint16, "ADC")
field("ldcn", "home", ProtoField.int32, "HOME")
field("ldcn", "device_id", ProtoField.uint8, "Device id")
field("ldcn", "version", ProtoField.uint8, "Version")
field("ldcn", "position_error", ProtoField.int16, "POSITION_ERROR")
field("ldcn", "bit7", ProtoField.uint8, "BIT7")
for _, register in ipairs(GAIN_REGISTERS) do
    field("ldcn", "gain." .. abbreviated(register[1]), ProtoField.uint16, register[1])
end
flag_fields("items", STATUS_ITEMS)
flag_fields("status", STATUS_FLAGS)
flag_fields("aux", AUX_FLAGS)
flag_fields("trajectory", TRAJECTORY_FLAGS)
flag_fields("stop", STOP_FLAGS)
flag_fields("homing", HOMING_FLAGS)
field("smartstep", "unit", ProtoField.uint8, "Unit number")
field("smartstep", "function", ProtoField.uint8, "Function", base.HEX, FUNCTIONS)
field("smartstep", "response", ProtoField.uint8, "Response status", base.HEX, RESPONSES)
field("smartstep", "address", ProtoField.uint16, "Address", base.HEX, REGISTERS)
field("smartstep", "data", ProtoField.uint16, "Data", base.HEX)
field("smartstep", "string", ProtoField.string, "String")
ldcn.fields = listed.ldcn
smartstep.fields = listed.smartstep

local unknown_dialect = ProtoExpert.new("ldcn.unknown_dialect", "The identity of this address was not seen before",
    expert.group.UNDECODED, expert.severity.NOTE)
local wrong_length = ProtoExpert.new("ldcn.wrong_length", "Another length than the request asks for",
    expert.group.MALFORMED, expert.severity.WARN)
ldcn.experts = {unknown_dialect, wrong_length}

-- -- what earlier packets have said ----------------------------------------------------------------------------------

local frames, wholes, pieces, dialects, masks, pending, parts, family

function serial.init()
    frames, wholes, pieces, dialects, masks = {}, {}, {}, {}, {}
    pending, parts, family = nil, nil, nil
end

local function dialect_of(device_id, version)
    for _, dialect in ipairs(DIALECTS) do
        if dialect.id == device_id and dialect.first <= version and version <= dialect.last then
            return dialect
        end
    end
end

local function flag_tree(tree, name, range, flags)
    local branch = tree:add(fields["ldcn." .. name], range)
    local names = {}
    for _, flag in ipairs(flags) do
        branch:add(fields["ldcn." .. name .. "." .. abbreviated(flag[2])], range)
        if has(range:uint(), flag[1]) then
            table.insert(names, flag[2])
        end
    end
    branch:append_text(" (" .. table.concat(names, ", ") .. ")")
    return table.concat(names, ", ")
end

-- Returns the items of a status packet as names and widths, nil where the dialect must be known and is not.
local function layout_of(mask, dialect)
    local items = {}
    for number, item in ipairs({
        {"position", 4}, {"adc", dialect and dialect.adc}, {"velocity", 2}, {"aux", 1}, {"home", 4}, {"identity", 2},
        {"position_error", dialect and dialect.position_error}, {"bit7", dialect and dialect.bit7},
    }) do
        if has(mask, 2 ^ (number - 1)) then
            if not item[2] then
                return nil
            end
            if item[2] > 0 then
                table.insert(items, item)
            end
        end
    end
    return items
end

-- Returns how long a status packet is, nil where that is not known.
local function status_bytes(mask, dialect)
    local items = layout_of(mask, dialect)
    if not items then
        return nil
    end
    local size = 2
    for _, item in ipairs(items) do
        size = size + item[2]
    end
    return size
end

-- -- LDCN requests ---------------------------------------------------------------------------------------------------

local decode = {}

function decode.SET_ADDRESS(tree, data)
    tree:add(fields["ldcn.new_address"], data(0, 1))
    local group = data(1, 1):uint()
    tree:add(fields["ldcn.group"], data(1, 1), group < 0x80 and group + 0x80 or group)
    tree:add(fields["ldcn.leader"], data(1, 1), group < 0x80)
end

function decode.DEFINE_STATUS(tree, data)
    flag_tree(tree, "items", data(0, 1), STATUS_ITEMS)
end

decode.READ_STATUS = decode.DEFINE_STATUS

function decode.STOP_MOTOR(tree, data)
    flag_tree(tree, "stop", data(0, 1), STOP_FLAGS)
    if data:len() >= 5 then
        tree:add_le(fields["ldcn.position"], data(1, 4))
    end
end

function decode.SET_HOMING_MODE(tree, data)
    flag_tree(tree, "homing", data(0, 1), HOMING_FLAGS)
end

function decode.SET_BAUD_RATE(tree, data)
    tree:add(fields["ldcn.divisor"], data(0, 1))
end

function decode.LOAD_TRAJECTORY(tree, data)
    flag_tree(tree, "trajectory", data(0, 1), TRAJECTORY_FLAGS)
    local control, at = data(0, 1):uint(), 1
    for number, name in ipairs({"position", "velocity", "acceleration"}) do
        if has(control, 2 ^ (number - 1)) and data:len() >= at + 4 then
            tree:add_le(fields["ldcn." .. name], data(at, 4))
            at = at + 4
        end
    end
    if has(control, 8) and data:len() > at then
        tree:add_le(fields["ldcn.pwm_or_target"], data(at, data:len() - at))
    end
end

function decode.SET_GAIN(tree, data)
    local at = 0
    for _, register in ipairs(GAIN_REGISTERS) do
        if data:len() >= at + register[2] then
            tree:add_le(fields["ldcn.gain." .. abbreviated(register[1])], data(at, register[2]))
        end
        at = at + register[2]
    end
end

-- Returns the packets of a request: their places, addresses, commands and data.
local function packets_in(tvb)
    local packets, at, stray = {}, 0, nil
    while at < tvb:len() do
        local left = tvb:len() - at
        local count = left >= 3 and math.floor(tvb(at + 2, 1):uint() / 16) or 0
        if tvb(at, 1):uint() == 0xAA and left >= 4 + count then
            local sum = 0
            for place = at + 1, at + 2 + count do
                sum = (sum + tvb(place, 1):uint()) % 256
            end
            local code = tvb(at + 2, 1):uint() % 16
            table.insert(packets, {
                at = at, count = count, address = tvb(at + 1, 1):uint(), command = COMMANDS[code],
                ok = sum == tvb(at + 3 + count, 1):uint(), data = count > 0 and tvb(at + 3, count):tvb() or nil,
            })
            at = at + 4 + count
        else
            stray, at = stray or at, at + 1
        end
    end
    return packets, stray
end

-- Notes what a request asks for, and what it changes, when it is seen for the first time.
local function note_request(number, time, packets)
    pending = nil
    for _, packet in ipairs(packets) do
        local address, data = packet.address, packet.data
        local mask = masks[address] or 0
        if packet.command == "READ_STATUS" and data then
            mask = data(0, 1):uint()
        elseif packet.command == "DEFINE_STATUS" and data then
            mask = data(0, 1):uint()
            masks[address] = mask
        elseif packet.command == "SET_ADDRESS" and data then
            local new = data(0, 1):uint()
            if new ~= address then
                dialects[new], masks[new] = dialects[address], masks[address]
                dialects[address], masks[address] = nil, nil
            end
        elseif packet.command == "HARD_RESET" then
            dialects, masks = {}, {}
        end
        pending = {number = number, time = time, address = address, mask = mask, dialect = dialects[address]}
        pending.bytes = status_bytes(pending.mask, pending.dialect)
        frames[number] = {dialect = dialects[address] and dialects[address].title}
    end
end

local function request(tvb, pinfo, tree)
    local packets, stray = packets_in(tvb)
    if not pinfo.visited then
        note_request(pinfo.number, pinfo.abs_ts, packets)
    end
    local names = {}
    for _, packet in ipairs(packets) do
        local range = tvb(packet.at, 4 + packet.count)
        local branch = tree:add(ldcn, range, string.format("LDCN %s to %d", packet.command, packet.address))
        branch:add(fields["ldcn.address"], tvb(packet.at + 1, 1))
        branch:add(fields["ldcn.command"], tvb(packet.at + 2, 1), tvb(packet.at + 2, 1):uint() % 16)
        branch:add(fields["ldcn.length"], tvb(packet.at + 2, 1), packet.count)
        if packet.data then
            local place = branch:add(fields["ldcn.data"], tvb(packet.at + 3, packet.count))
            if decode[packet.command] and packet.ok then
                decode[packet.command](place, tvb(packet.at + 3, packet.count))
            end
        end
        branch:add(fields["ldcn.checksum"], tvb(packet.at + 3 + packet.count, 1))
        branch:add(fields["ldcn.checksum_ok"], tvb(packet.at + 3 + packet.count, 1), packet.ok)
        local known = frames[pinfo.number] or {}
        if known.reply then
            branch:add(fields["ldcn.reply"], known.reply):set_generated()
        end
        table.insert(names, string.format("%s %d", packet.command, packet.address))
    end
    if stray then
        tree:add(ldcn, tvb(stray), "LDCN bytes outside a packet"):add(fields["ldcn.surplus"], tvb(stray))
    end
    pinfo.cols.info = #names > 0 and table.concat(names, ", ") or string.format("%d bytes outside a packet", tvb:len())
end

-- -- LDCN replies ----------------------------------------------------------------------------------------------------

local function status_items(tvb, branch, items)
    local at = 1
    for _, item in ipairs(items) do
        local name, range = item[1], tvb(at, item[2])
        if name == "aux" then
            flag_tree(branch, "aux", range, AUX_FLAGS)
        elseif name == "identity" then
            branch:add(fields["ldcn.device_id"], range(0, 1))
            branch:add(fields["ldcn.version"], range(1, 1))
        elseif name == "velocity" then
            branch:add(fields["ldcn.velocity"], range, range:le_int())
        else
            branch:add_le(fields["ldcn." .. name], range)
        end
        at = at + item[2]
    end
end

local function status_packet(tvb, pinfo, tree)
    local known = frames[pinfo.number]
    local branch = tree:add(ldcn, tvb(), "LDCN status packet")
    if not known then
        pinfo.cols.info = "status packet without a request"
        return
    end
    branch:add(fields["ldcn.request"], known.request):set_generated()
    branch:add(fields["ldcn.time"], known.time):set_generated()
    branch:add(fields["ldcn.address"], known.address):set_generated()
    if known.dialect then
        branch:add(fields["ldcn.dialect"], known.dialect.title):set_generated()
    end
    local names = flag_tree(branch, "status", tvb(0, 1), STATUS_FLAGS)
    local items, sum = layout_of(known.mask, known.dialect), 0
    for place = 0, tvb:len() - 2 do
        sum = (sum + tvb(place, 1):uint()) % 256
    end
    branch:add(fields["ldcn.checksum"], tvb(tvb:len() - 1, 1))
    branch:add(fields["ldcn.checksum_ok"], tvb(tvb:len() - 1, 1), sum == tvb(tvb:len() - 1, 1):uint())
    if not items then
        branch:add_proto_expert_info(unknown_dialect)
    elseif status_bytes(known.mask, known.dialect) == tvb:len() then
        status_items(tvb, branch, items)
    else
        branch:add_proto_expert_info(wrong_length)
    end
    pinfo.cols.info = string.format("%d: %s", known.address, names)
end

local function note_reply(tvb, pinfo)
    if not pending then
        return
    end
    local dialect = pending.dialect
    if has(pending.mask, 0x20) then
        local items = layout_of(pending.mask % 0x40, dialect or dialect_of(0, 4))
        local at = 1
        for _, item in ipairs(items) do
            if item[1] == "identity" and tvb:len() >= at + 2 then
                dialect = dialect_of(tvb(at, 1):uint(), tvb(at + 1, 1):uint())
                dialects[pending.address] = dialect
            end
            at = at + item[2]
        end
    end
    frames[pinfo.number] = {
        request = pending.number, time = pinfo.abs_ts - pending.time, address = pending.address, mask = pending.mask,
        dialect = dialect,
    }
    if frames[pending.number] then
        frames[pending.number].reply = pinfo.number
    end
    pending = nil
end

-- -- SmartStep -------------------------------------------------------------------------------------------------------

local PACKET_CHARACTERS = 14

local function digits(tvb, at, count)
    return tonumber(tvb(at, count):string(), 16)
end

local function smartstep_packet(tvb, pinfo, tree, outbound)
    local branch = tree:add(smartstep, tvb(), "SmartStep")
    if tvb:len() < PACKET_CHARACTERS or tvb(0, 1):string() ~= "W" or not digits(tvb, 1, 12) then
        branch:add(fields["smartstep.surplus"], tvb())
        pinfo.cols.info = "bytes outside a packet"
        return
    end
    local unit, code = digits(tvb, 1, 1), digits(tvb, 2, 1)
    local address, data = digits(tvb, 3, 4), digits(tvb, 7, 4)
    local sum = 0
    for place = 1, 11, 2 do
        sum = (sum + digits(tvb, place, 2)) % 256
    end
    local string_reply = not outbound and code == tonumber(STRING_REFERENCE) and tvb:len() > PACKET_CHARACTERS
    branch:add(fields["smartstep.unit"], tvb(1, 1), unit)
    branch:add(fields[outbound and "smartstep.function" or "smartstep.response"], tvb(2, 1), code)
    branch:add(fields["smartstep.address"], tvb(3, 4), address)
    branch:add(fields["smartstep.data"], tvb(7, 4), data)
    branch:add(fields["smartstep.checksum"], tvb(11, 2), digits(tvb, 11, 2))
    branch:add(fields["smartstep.checksum_ok"], tvb(11, 2), sum == 0)
    if string_reply then
        branch:add(fields["smartstep.string"], tvb(PACKET_CHARACTERS))
    end
    local known = frames[pinfo.number] or {}
    if known.request then
        branch:add(fields["smartstep.request"], known.request):set_generated()
        branch:add(fields["smartstep.time"], known.time):set_generated()
    end
    if known.reply then
        branch:add(fields["smartstep.reply"], known.reply):set_generated()
    end
    local what = outbound and FUNCTIONS[code] or RESPONSES[code]
    local name = REGISTERS[address] or string.format("%04XH", address)
    pinfo.cols.info = string.format("%d: %s %s %04X", unit, what or "?", name, data)
end

-- -- the line --------------------------------------------------------------------------------------------------------

local function note_smartstep(pinfo, outbound)
    if outbound then
        pending = {number = pinfo.number, time = pinfo.abs_ts}
        frames[pinfo.number] = {}
    elseif pending then
        frames[pinfo.number] = {request = pending.number, time = pinfo.abs_ts - pending.time}
        frames[pending.number].reply = pinfo.number
        pending = nil
    end
end

-- Tells whether all of a reply is there.
local function complete(data)
    if family == "smartstep" then
        local last = data:len() > 0 and data:get_index(data:len() - 1)
        local is_string = data:len() > 2 and data:get_index(2) == string.byte(STRING_REFERENCE)
        return last == 0x0D and data:len() >= PACKET_CHARACTERS and not (is_string and data:len() == PACKET_CHARACTERS)
    end
    return not (pending and pending.bytes) or data:len() >= pending.bytes
end

-- Notes the pieces of a reply until it is whole; captures may have it byte by byte.
local function note_received(tvb, pinfo)
    local data = parts and (parts .. tvb:bytes()) or tvb:bytes()
    if not complete(data) then
        parts = data
        pieces[pinfo.number] = true
        return
    end
    if parts then
        wholes[pinfo.number] = data
    end
    parts = nil
    if family == "smartstep" then
        note_smartstep(pinfo, false)
    else
        note_reply(data:tvb("Reply"), pinfo)
    end
end

function serial.dissector(tvb, pinfo, tree)
    local direction = pinfo.p2p_dir
    if direction == SENT and not family and tvb:len() > 0 then
        family = tvb(0, 1):uint() == 0x57 and "smartstep" or "ldcn"
    end
    local proto = family == "smartstep" and smartstep or ldcn
    pinfo.cols.protocol = proto.name
    if tvb:len() == 0 or (direction ~= SENT and direction ~= RECEIVED) then
        local comment = comment_of()
        pinfo.cols.info = comment and tostring(comment.value) or "no packet"
        tree:add(proto, tvb(), tostring(pinfo.cols.info))
        return
    end
    if direction == SENT then
        if not pinfo.visited then
            parts = nil
            if family == "smartstep" then
                note_smartstep(pinfo, true)
            end
        end
        if family == "smartstep" then
            smartstep_packet(tvb, pinfo, tree, true)
        else
            request(tvb, pinfo, tree)
        end
        return
    end
    if not pinfo.visited then
        note_received(tvb, pinfo)
    end
    if pieces[pinfo.number] then
        pinfo.cols.info = string.format("%d bytes of a reply", tvb:len())
        tree:add(proto, tvb(), "Part of a reply")
        return
    end
    local whole = wholes[pinfo.number] and wholes[pinfo.number]:tvb("Whole reply") or tvb
    if family == "smartstep" then
        smartstep_packet(whole, pinfo, tree, false)
    else
        status_packet(whole, pinfo, tree)
    end
end

DissectorTable.get("wtap_encap"):add(wtap.USER0, serial)
