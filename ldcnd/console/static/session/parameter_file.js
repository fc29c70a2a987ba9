/** Dumps of parameters as TOML, the same files that `ldcnd params` writes and reads. */

const LINE = /^\s*"?(Pn[0-9A-Fa-f]{3})"?\s*=\s*(0x[0-9A-Fa-f]+|\d+)\s*(#.*)?$/;
const LARGEST = 0xffff;

/** Return a dump: from which drive it is, and what both memories hold. */
export function asToml(axis, { values, facts }) {
  const stored = values.map(({ parameter, stored, name }) => `${parameter} = ${stored}  # ${name}`);
  const inUse = values.map(({ parameter, active }) => `${parameter} = ${active}`);
  const about = facts
    ? `driver_type = ${facts.driver_type}\nsoftware_version = ${facts.software_version}\nunit = ${facts.unit}\n` +
      `gain_switch = ${facts.gain_switch}\nswitches_on = ${JSON.stringify(facts.switches.map((each) => each.toLowerCase()))}\n`
    : "";
  const head = `axis = "${axis}"\nread_at = ${new Date().toISOString()}\n${about}`;
  return `${head}\n[parameters]\n${stored.join("\n")}\n\n[in_use]\n${inUse.join("\n")}\n`;
}

/** Return the type of the drive that a dump is from; null where it does not say. */
export function driverTypeOf(text) {
  const [, number] = /^\s*driver_type\s*=\s*(0x[0-9A-Fa-f]+|\d+)/m.exec(text) ?? [];
  return number === undefined ? null : Number(number);
}

/** Return the values of a dump by parameter; raises an Error that names the line which is none. */
export function fromToml(text) {
  const values = new Map();
  let inside = false;
  text.split(/\r?\n/).forEach((line, index) => {
    if (/^\s*\[/.test(line)) inside = line.trim() === "[parameters]";
    else if (inside && line.trim() && !line.trim().startsWith("#")) {
      const [, parameter, number] = LINE.exec(line) ?? [];
      const value = Number(number);
      if (!parameter || value > LARGEST) throw new Error(`Line ${index + 1} is no parameter: ${line.trim()}`);
      values.set(parameter, value);
    }
  });
  if (!values.size) throw new Error("This file holds no [parameters].");
  return values;
}
