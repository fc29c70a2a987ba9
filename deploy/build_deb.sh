#!/bin/bash
# build_deb.sh OUT_DIR: the Debian packages of this checkout for the Debian release it runs on: an environment in
# /opt/ldcnd on Debian's Python, and what others add to it (`DEBIAN` in ldcnd/parts.py), each with its bill of
# materials. Prints their paths. Needs uv (in .venv) and dpkg-deb.
# COMPRESSION: xz, or none where time matters more than size. UV_OFFLINE=1: nothing is fetched. ONLY: the packages to
# make, where not all are needed. Same input and SOURCE_DATE_EPOCH: same bytes.
set -euo pipefail

out=$(mkdir -p "$1" && cd "$1" && pwd)
here=$(cd "$(dirname "$0")" && pwd)
source=$(dirname "$here")
uv=${UV:-$(PATH=$PATH:$source/.venv/bin command -v uv)}
python=${PYTHON:-/usr/bin/python3}
export SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-1700000000} PYTHONHASHSEED=0
stage=$(mktemp -d)
trap 'rm -rf "$stage"' EXIT
umask 022
opt=$stage/environment/opt/ldcnd
old_systemd=$([ "$(systemctl --version | sed -n '1s/^systemd \([0-9]*\).*/\1/p')" -ge 253 ] || echo 1)

"$uv" build --quiet --wheel --build-constraints "$source/constraints.txt" --python "$python" --out-dir "$stage" "$source"
wheel=$(echo "$stage"/*.whl)
"$uv" venv --quiet --no-config --python "$python" "$stage/bom"
"$uv" pip install --quiet --python "$stage/bom/bin/python" -c "$source/constraints.txt" cyclonedx-bom
version=$(basename "$wheel" | cut -d- -f2)
"$uv" venv --quiet --no-config --relocatable --python "$python" "$opt"
rm -f "$opt/.lock" "$opt"/bin/activate* "$opt"/bin/deactivate* "$opt"/CACHEDIR.TAG "$opt"/.gitignore

install_parts() { # [EXTRAS]
    "$uv" pip install --quiet --python "$opt/bin/python" --link-mode copy -c "$source/constraints.txt" "$wheel${1:+[$1]}"
    find "$opt" \( -name direct_url.json -o -name uv_cache.json -o -name uv_build.json -o -name .lock \) -delete
}

# the files of the environment that no package before has, as the files of this one
take_new_files() { # PACKAGE
    local root=$stage/$1
    mkdir -p "$root"
    touch "$stage/taken"
    (cd "$stage/environment" && find . ! -type d ! -name '*.pyc' | sort) > "$stage/all"
    comm -23 "$stage/all" "$stage/taken" | tar -C "$stage/environment" -c -T - | tar -C "$root" -x
    mv "$stage/all" "$stage/taken"
    find "$root/opt" -path '*/ldcnd/bin/*' ! -name 'python*' ! -name ldcnd -delete
    find "$root/opt" -name '*.so*' -type f -exec chmod 644 {} +
    # RECORD lists what was deleted or comes after it; nothing reads it where pip is not
    find "$root/opt" -path '*.dist-info/RECORD' -delete
    # /opt is read-only for the service: compiled code must be there, and must not ask for the age of its source.
    "$opt/bin/python" -m compileall -q -j 0 -s "$root" -p / --invalidation-mode unchecked-hash "$root/opt/ldcnd/lib"
}

unit() { # FILE PROGRAM DESCRIPTION ROOT: a program beside the daemon
    local place=$4/usr/lib/systemd/system name=ldcnd-$2@
    mkdir -p "$place/${name}ldcnd.service.d"
    sed -e "s/@NAME@/$2/g; s/@OPTIONS@/${2^^}/g; s/@WHAT@/$3/" "$1" | sandboxed > "$place/$name.service"
    # the rig of ldcnd.service is /etc/ldcnd/ldcnd.toml, so what is beside it is the instance `ldcnd`
    printf '[Unit]\nAfter=ldcnd.service\n\n[Install]\nWantedBy=ldcnd.service\n' \
        > "$place/${name}ldcnd.service.d/ldcnd.conf"
}

sandboxed() { cat - <(echo) <(sed '/^# Of every unit/,/^$/d' "$here/units/sandbox.conf"); }

documents() { # PACKAGE
    local doc=$stage/$1/usr/share/doc/$1
    mkdir -p "$doc"
    {
        printf 'Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/\nUpstream-Name: ldcnd\n'
        printf 'Comment: /opt/ldcnd holds other Python packages, too: the licence of NAME is in NAME-VERSION.dist-info\n'
        printf ' beside it, and /usr/share/doc/ldcnd/sbom.cdx.json lists them.\n\n'
        printf 'Files: *\nCopyright: the contributors of ldcnd\nLicense: Apache-2.0\n'
        printf ' On Debian systems its text is in /usr/share/common-licenses/Apache-2.0.\n'
        for licence in "$source"/ldcnd/console/static/vendor/*/LICENSE*; do
            local folder=${licence#"$source"/} holder=
            holder=$(grep -im1 '^ *copyright.*[0-9]\{4\}' "$licence" | sed 's/^ *Copyright *//I') || holder="see its text"
            printf '\nFiles: opt/ldcnd/*/%s/*\nCopyright: %s\n' "$(dirname "$folder")" "$holder"
            if grep -q 'Apache License' "$licence"; then
                printf 'License: Apache-2.0\n'
                continue
            fi
            printf 'License: vendored-%s\n' "$(basename "$(dirname "$licence")")$(basename "$licence" | sed 's/^LICENSE//')"
            sed 's/^ *$/./; s/^/ /' "$licence"
        done
    } > "$doc/copyright"
    {
        printf 'ldcnd (%s) unstable; urgency=medium\n\n  * Release %s; /usr/share/doc/ldcnd/CHANGELOG.md.gz.\n\n' "$version" "$version"
        printf ' -- ldcnd maintainers <ldcnd@localhost>  %s\n' "$(LC_ALL=C date -u -R -d "@$SOURCE_DATE_EPOCH")"
    } | gzip -9n > "$doc/changelog.gz"
    mkdir -p "$stage/$1/usr/share/lintian/overrides"
    sed "s/^PACKAGE/$1/" "$here/lintian-overrides" > "$stage/$1/usr/share/lintian/overrides/$1"
}

main_package() {
    local root=$stage/ldcnd units doc
    units=$root/usr/lib/systemd/system
    doc=$root/usr/share/doc/ldcnd
    # how ldcnd came here: a hint for a missing part names Debian's packages
    printf 'debian\n' > "$(echo "$root"/opt/ldcnd/lib/python*/site-packages/ldcnd-*.dist-info)/INSTALLER"
    mkdir -p "$units" "$root/etc/ldcnd" "$root/usr/bin"
    sandboxed < "$here/units/ldcnd@.service" > "$units/ldcnd@.service"
    if [ "$old_systemd" ]; then
        sed -i '/^# Before systemd 253/d; /^Type=notify-reload$/d' "$units/ldcnd@.service"
        install -Dm644 "$here/drop-ins/systemd-252@.conf" "$units/ldcnd@.service.d/systemd-252.conf"
    fi
    for each in ldcnd@.service ldcnd@.service.d/systemd-252.conf; do # ldcnd.service is the same for /etc/ldcnd/ldcnd.toml
        [ -e "$units/$each" ] || continue
        mkdir -p "$(dirname "$units/${each/@/}")"
        sed 's/%i\.toml/ldcnd.toml/; s/ (%i)$//; s,/%i$,,; s/^# The rig NAME.*/# One rig on this machine; see ldcnd@.service for more./' \
            "$units/$each" > "$units/${each/@/}"
    done
    unit "$here/units/beside@.service" console "Console in browsers" "$root"
    unit "$here/units/beside@.service" metrics "Metrics for Prometheus" "$root"
    unit "$here/units/beside@.service" record "Recording" "$root"
    sed -i 's,^ExecStart=.* record,& --out /var/lib/ldcnd-record/%i/%%Y%%m%%d-%%H%%M%%S.mcap,; s,^RuntimeDirectory=.*,StateDirectory=ldcnd-record/%i\nStateDirectoryMode=0750,; /^RuntimeDirectory[MP]/d' \
        "$units/ldcnd-record@.service"
    install -Dm644 "$here/units/ldcnd.env" "$root/etc/ldcnd/ldcnd.env"
    install -Dm644 "$here/udev/71-ldcnd.rules" "$root/usr/lib/udev/rules.d/71-ldcnd.rules"
    install -Dm644 "$here/sysusers.d/ldcnd.conf" "$root/usr/lib/sysusers.d/ldcnd.conf"
    install -Dm644 "$here/modules-load.d/ldcnd.conf" "$root/usr/lib/modules-load.d/ldcnd.conf"
    install -Dm644 -t "$doc/examples" "$here/drop-ins/"*[^@].conf "$source"/config/*.toml
    install -Dm644 -t "$doc/examples/grafana" "$here"/grafana/*
    (cd "$source/config" && find zenoh -type f -exec install -Dm644 {} "$doc/examples/{}" \;)
    (cd "$source" && find examples -type f ! -name '*.pyc' -exec install -Dm644 {} "$doc/{}" \;)
    ln -s examples "$doc/config" # as pages find it
    install -Dm644 -t "$doc" "$here/INSTALL.md"
    # without what only a built site needs: its index; the copies that it makes are made here, too, for the pages' links
    (cd "$source" && find docs -type f ! -name conf.py ! -name index.md ! -name install.md ! -path 'docs/faults/*' \
        -exec install -Dm644 {} "$doc/{}" \;)
    install -Dm644 -t "$doc/docs/faults" "$source"/ldcnd/contract/fault_pages/*.md
    ln -s ../../INSTALL.md "$doc/docs/how-to/install.md"
    gzip -9nc "$source/CHANGELOG.md" > "$doc/CHANGELOG.md.gz"
    ln -s /opt/ldcnd/bin/ldcnd "$root/usr/bin/ldcnd"
    (cd "$source" && "$opt/bin/python" -m tools man "$root/usr/share/man/man1")
    gzip -9n "$root"/usr/share/man/man1/*.1
    mkdir -p "$root"/usr/share/{bash-completion/completions,zsh/vendor-completions,fish/vendor_completions.d}
    _LDCND_COMPLETE=bash_source "$opt/bin/ldcnd" > "$root/usr/share/bash-completion/completions/ldcnd"
    _LDCND_COMPLETE=zsh_source "$opt/bin/ldcnd" > "$root/usr/share/zsh/vendor-completions/_ldcnd"
    _LDCND_COMPLETE=fish_source "$opt/bin/ldcnd" > "$root/usr/share/fish/vendor_completions.d/ldcnd.fish"
    plugins=$root/usr/lib/$("$python" -c 'import sysconfig; print(sysconfig.get_config_var("MULTIARCH"))')/wireshark/plugins
    mkdir -p "$plugins"
    "$opt/bin/python" -c 'from ldcnd.ops.dissector import dissector; print(dissector(), end="")' > "$plugins/ldcnd.lua"

    mkdir -p "$root/DEBIAN"
    echo /etc/ldcnd/ldcnd.env > "$root/DEBIAN/conffiles"
    cat > "$root/DEBIAN/postinst" <<'POSTINST'
#!/bin/sh
set -e
[ "$1" = configure ] || exit 0
systemd-sysusers ldcnd.conf
[ -d /run/systemd/system ] || exit 0
systemctl daemon-reload
if udevadm control --reload 2>/dev/null; then
    udevadm trigger --subsystem-match=tty --subsystem-match=usb-serial || true
    udevadm trigger --sysname-match=cpu_dma_latency || true
fi
# A restart stops what moves: that is for the operator to choose.
if [ -n "$2" ]; then echo "ldcnd: running daemons are still the old version; restart them when nothing moves"; fi
POSTINST
    cat > "$root/DEBIAN/prerm" <<'PRERM'
#!/bin/sh
set -e
if [ "$1" = remove ] && [ -d /run/systemd/system ]; then
    systemctl disable --now --quiet ldcnd.service
    systemctl stop 'ldcnd@*.service' 'ldcnd-*@*.service'
fi
if [ "$1" = remove ]; then # what was enabled is so no more, as ldcnd.service
    find /etc/systemd/system -path '*.wants/ldcnd*.service' -type l -delete
    find /etc/systemd/system -name 'ldcnd*.wants' -type d -empty -delete
fi
PRERM
    cat > "$root/DEBIAN/postrm" <<'POSTRM'
#!/bin/sh
set -e
if [ -d /run/systemd/system ]; then systemctl daemon-reload; fi
POSTRM
    chmod 755 "$root"/DEBIAN/{postinst,prerm,postrm}
}

# In KiB as Debian's policy counts it: how large a folder itself is depends on the file system that it was built on
installed_size() { # ROOT
    find "$1" -path "$1/DEBIAN" -prune -o -type f -printf '%s\n' -o -printf '1\n' |
        awk '{ size += int(($1 + 1023) / 1024) } END { print size }'
}

pack() { # PACKAGE DEPENDS SUMMARY
    local root=$stage/$1 package
    mkdir -p "$root/DEBIAN"
    cat > "$root/DEBIAN/control" <<CONTROL
Package: $1
Version: $version
Architecture: $(dpkg --print-architecture)
Depends: $2
Maintainer: ldcnd maintainers <ldcnd@localhost>
Section: electronics
Priority: optional
Installed-Size: $(installed_size "$root")
Description: $3
 ldcnd owns RS-485 lines of Logosol LDCN, J R Kerr NMC and OMRON SmartStep
 drives and lets clients watch and move them over Zenoh.
CONTROL
    (cd "$root" && find . -type f ! -path './DEBIAN/*' ! -path './etc/*' -printf '%P\0' | sort -z | xargs -0 md5sum) > "$root/DEBIAN/md5sums"
    package=$out/$1_${version}_$(dpkg --print-architecture).deb
    dpkg-deb --root-owner-group -Z"${COMPRESSION:-xz}" --build "$root" "$package" >/dev/null
    cp "$root/usr/share/doc/$1/sbom.cdx.json" "${package%.deb}.cdx.json"
    echo "$package"
}

release=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
install_parts ""
"$opt/bin/python" -c 'from ldcnd.parts import DEBIAN
for name, extras in DEBIAN.items(): print(name, ",".join(extras))' > "$stage/packages"
depends="libc6, systemd"
of_python="python3 (>= $release), python3 (<< ${release%.*}.$((${release#*.} + 1)))"
while read -r name extras; do
    install_parts "$extras"
    take_new_files "$name"
    documents "$name"
    summary="servo drives on RS-485 lines, over Zenoh"
    case $name in
        ldcnd) main_package ;;
        ldcnd-tuning) summary="commissioning, tuning and plots for ldcnd" ;;
        ldcnd-bridges)
            summary="EPICS, SECoP, Bluesky and Foxglove for ldcnd"
            unit "$here/units/beside@.service" epics "EPICS motor records" "$stage/$name"
            unit "$here/units/beside@.service" secop "SECoP node" "$stage/$name"
            ;;
    esac
    doc=$stage/$name/usr/share/doc/$name
    (cd "$source" && CYCLONEDX=$stage/bom/bin/cyclonedx-py "$opt/bin/python" -m tools sbom "$doc/sbom.cdx.json")
    [[ " ${ONLY:-$name} " != *" $name "* ]] || pack "$name" "$of_python, $depends" "$summary"
    depends="libc6, $name (= $version)"
    [[ $name != "${ONLY:-}" ]] || break
done < "$stage/packages"
