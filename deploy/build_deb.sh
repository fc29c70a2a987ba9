#!/bin/bash
# build_deb.sh OUT_DIR: a Debian package of this checkout for the Debian release it runs on, with an environment of its
# own in /opt/ldcnd on Debian's Python. Prints the package's path. Needs uv, cyclonedx-bom (both in .venv) and dpkg-deb.
# EXTRAS: optional parts to put in. COMPRESSION: xz, or none where time matters more than size. UV_OFFLINE=1: nothing is
# fetched. Same input and SOURCE_DATE_EPOCH: same bytes.
set -euo pipefail

out=$(mkdir -p "$1" && cd "$1" && pwd)
here=$(cd "$(dirname "$0")" && pwd)
source=$(dirname "$here")
uv=${UV:-$(PATH=$PATH:$source/.venv/bin command -v uv)}
bom=${CYCLONEDX:-$(PATH=$PATH:$(dirname "$uv") command -v cyclonedx-py)}
python=${PYTHON:-/usr/bin/python3}
extras=${EXTRAS-fast,journal}
export SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-1700000000} PYTHONHASHSEED=0
stage=$(mktemp -d)
trap 'rm -rf "$stage"' EXIT
umask 022
root=$stage/root
opt=$root/opt/ldcnd
units=$root/usr/lib/systemd/system
doc=$root/usr/share/doc/ldcnd

"$uv" build --quiet --wheel --build-constraints "$source/constraints.txt" --python "$python" --out-dir "$stage" "$source"
wheel=$(echo "$stage"/*.whl)
version=$(basename "$wheel" | cut -d- -f2)

"$uv" venv --quiet --no-config --relocatable --python "$python" "$opt"
"$uv" pip install --quiet --python "$opt/bin/python" --link-mode copy -c "$source/constraints.txt" \
    "$wheel${extras:+[$extras]}"
rm -f "$opt/.lock" "$opt"/bin/activate* "$opt"/bin/deactivate* "$opt"/CACHEDIR.TAG "$opt"/.gitignore
find "$opt" \( -name direct_url.json -o -name uv_cache.json -o -name uv_build.json \) -delete
# /opt is read-only for the service: compiled code must be there, and must not ask for the age of its source.
"$opt/bin/python" -m compileall -q -j 0 -s "$root" -p / --invalidation-mode unchecked-hash "$opt/lib"
# RECORD lists what was deleted or came after it; nothing reads it where pip is not
find "$opt" -path '*.dist-info/RECORD' -delete

install -Dm644 -t "$units" "$here/ldcnd.service" "$here/ldcnd@.service"
if [ "$(systemctl --version | sed -n '1s/^systemd \([0-9]*\).*/\1/p')" -lt 253 ]; then
    sed -i '/^# Before systemd 253/d; /^Type=notify-reload$/d' "$units/ldcnd.service" "$units/ldcnd@.service"
    install -Dm644 "$here/drop-ins/systemd-252.conf" "$units/ldcnd.service.d/systemd-252.conf"
    install -Dm644 "$here/drop-ins/systemd-252@.conf" "$units/ldcnd@.service.d/systemd-252.conf"
fi
install -Dm644 "$here/udev/71-ldcnd.rules" "$root/usr/lib/udev/rules.d/71-ldcnd.rules"
install -Dm644 "$here/sysusers.d/ldcnd.conf" "$root/usr/lib/sysusers.d/ldcnd.conf"
install -Dm644 "$here/modules-load.d/ldcnd.conf" "$root/usr/lib/modules-load.d/ldcnd.conf"
install -Dm644 -t "$doc/examples" "$here/drop-ins/"{realtime,nice,lan,single-line}.conf "$source"/config/*.toml
install -Dm644 "$here/INSTALL.md" "$doc/INSTALL.md"
install -Dm644 "$source/LICENSE" "$doc/copyright"
"$bom" environment "$opt/bin/python" --of JSON --output-reproducible --output-file "$doc/sbom.cdx.json"
(cd "$source" && "$opt/bin/python" -m tools man "$root/usr/share/man/man1")
gzip -9n "$root"/usr/share/man/man1/*.1
plugins=$root/usr/lib/$("$python" -c 'import sysconfig; print(sysconfig.get_config_var("MULTIARCH"))')/wireshark/plugins
mkdir -p "$plugins"
"$opt/bin/python" -c 'from ldcnd.ops.dissector import dissector; print(dissector(), end="")' > "$plugins/ldcnd.lua"
mkdir -p "$root/etc/ldcnd" "$root/usr/bin" "$root/DEBIAN"
ln -s /opt/ldcnd/bin/ldcnd "$root/usr/bin/ldcnd"

release=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
next=${release%.*}.$((${release#*.} + 1))
package=$out/ldcnd_${version}_$(dpkg --print-architecture).deb
cat > "$root/DEBIAN/control" <<CONTROL
Package: ldcnd
Version: $version
Architecture: $(dpkg --print-architecture)
Depends: python3 (>= $release), python3 (<< $next), systemd
Maintainer: ldcnd <root@localhost>
Section: electronics
Priority: optional
Installed-Size: $(du -sk --apparent-size "$root" | cut -f1)
Description: servo drives on RS-485 lines, over Zenoh
 Owns lines of Logosol LDCN, J R Kerr NMC and OMRON SmartStep drives and lets clients
 watch and move them.
CONTROL
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
    systemctl stop 'ldcnd@*.service'
fi
PRERM
cat > "$root/DEBIAN/postrm" <<'POSTRM'
#!/bin/sh
set -e
if [ -d /run/systemd/system ]; then systemctl daemon-reload; fi
POSTRM
chmod 755 "$root"/DEBIAN/{postinst,prerm,postrm}
dpkg-deb --root-owner-group -Z"${COMPRESSION:-xz}" --build "$root" "$package" >/dev/null
echo "$package"
