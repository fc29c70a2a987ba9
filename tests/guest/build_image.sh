#!/bin/bash
# build_image.sh OUT_DIR [--key]: a small machine of the Debian release this runs on, with the stock kernel, for QEMU:
# OUT_DIR/vmlinuz, OUT_DIR/initrd and OUT_DIR/root.ext4. `--key` prints what it is made of instead: the versions of the
# kernel and of all packages named here, and this folder's scripts. Needs root, mmdebstrap, apt, cpio and mke2fs.
set -euo pipefail

here=$(cd "$(dirname "$0")" && pwd)
release=$(. /etc/os-release && echo "$VERSION_CODENAME")
packages=(systemd systemd-sysv udev kmod dbus python3 iproute2 procps util-linux psmisc)
for_root=(virtio_pci virtio_blk ext4 crc32c_generic)
# these are loaded by udev and by the units; Debian's kernel has the 8250 built in
modules=("${for_root[@]}" virtio_net virtio_rng xhci_pci ftdi_sio cdc_acm autofs4)
kernel=$(apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: \(linux-image-[0-9].*\)/\1/p' | head -1)

if [ "${2:-}" = --key ]; then
    apt-cache show --no-all-versions "$kernel" "${packages[@]}" | sed -n 's/^\(Package\|Version\): //p' | paste - -
    cat "$0" "$here/agent.py"
    exit
fi

out=$(mkdir -p "$1" && cd "$1" && pwd)
work=$(mktemp -d "$out/build.XXXXXX")
root=$work/root
clean() { # what was interrupted may have left mounts of this machine's /proc, /sys and /dev: never remove through them
    awk -v top="$work/" 'index($2, top) == 1 { print $2 }' /proc/mounts | sort -r | while read -r mounted; do
        umount "$mounted" || exit 1
    done || return
    rm -rf --one-file-system "$work"
}
trap clean EXIT
trap 'exit 1' INT TERM

mmdebstrap --quiet --mode=root --variant=essential --include="$(IFS=,; echo "${packages[*]}")" \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
    --dpkgopt='path-exclude=/usr/share/locale/*' --dpkgopt=force-unsafe-io \
    --aptopt='APT::Install-Recommends "false"' "$release" "$root" >&2

# the kernel without its package: no initrd is made for it, and only the modules that are needed are kept
(cd "$work" && apt-get -qq download "$kernel" 2>/dev/null && dpkg-deb -x "$kernel"_*.deb kernel)
version=${kernel#linux-image-}
mkdir -p "$root/usr/lib/modules"
mv "$work/kernel/lib/modules/$version" "$root/usr/lib/modules/"
chroot "$root" depmod "$version"
files_of() {
    for module; do
        chroot "$root" modprobe --set-version "$version" --show-depends "$module" | awk '$1 == "insmod" { print $2 }'
    done | sed "s|^/lib|$root/usr/lib|" | awk '!seen[$0]++' # in the order in which they need each other
}
files_of "${modules[@]}" > "$work/kept"
find "$root/usr/lib/modules" -name '*.ko' | grep -vxFf "$work/kept" | xargs -d '\n' rm
chroot "$root" depmod "$version"
cp "$work/kernel/boot/vmlinuz-$version" "$work/vmlinuz"

# the first root only loads what the second one takes
first=$work/first
files_of "${for_root[@]}" | nl -n rz -w 2 | while read -r number file; do
    install -D "$file" "$first/modules/$number-${file##*/}"
done
for tool in bash mount switch_root insmod; do
    file=$(chroot "$root" bash -c "readlink -f \$(type -P $tool)")
    install -D "$root$file" "$first/bin/$tool"
    chroot "$root" ldd "$file" | grep -o '/lib[^ ]*' | while read -r library; do
        install -D "$root/usr$library" "$first$library"
    done
done
cat > "$first/init" <<'INIT'
#!/bin/bash
export PATH=/bin
for module in /modules/*.ko; do insmod "$module"; done
mount -t devtmpfs dev /dev
until mount -t ext4 /dev/vda /root 2>/dev/null; do :; done
mount --move /dev /root/dev
exec switch_root /root /lib/systemd/systemd
INIT
chmod 755 "$first/init"
mkdir "$first"/{dev,root}
(cd "$first" && find . -print0 | cpio --quiet --null --create --format newc | gzip -1) > "$work/initrd"

install -m 755 "$here/agent.py" "$root/usr/local/sbin/guest-agent"
cat > "$root/etc/systemd/system/guest-agent.service" <<'UNIT'
[Unit]
Description=Commands of the test
DefaultDependencies=no
After=systemd-udev-trigger.service systemd-journald.socket

[Service]
ExecStartPre=/bin/bash -c 'for i in $(seq 100); do [ -e /sys/class/net/eth0 ] && break; sleep 0.1; done'
ExecStartPre=/sbin/ip link set lo up
ExecStartPre=/sbin/ip address replace 10.0.2.15/24 dev eth0
ExecStartPre=/sbin/ip link set eth0 up
ExecStart=/usr/local/sbin/guest-agent
Restart=always
RestartSec=0.5
OOMScoreAdjust=-1000
UNIT
mkdir -p "$root/etc/systemd/system/multi-user.target.wants"
ln -s ../guest-agent.service "$root/etc/systemd/system/multi-user.target.wants/"
ln -sf /lib/systemd/system/multi-user.target "$root/etc/systemd/system/default.target"
# an emulated processor takes seconds for each of these, and no test is about them
for unit in apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer e2scrub_all.timer e2scrub_reap.service \
    fstrim.timer getty.target serial-getty@ttyS0.service systemd-logind.service systemd-update-utmp.service \
    systemd-update-utmp-runlevel.service systemd-user-sessions.service systemd-journal-flush.service \
    systemd-random-seed.service systemd-pstore.service systemd-tmpfiles-clean.timer \
    dbus.service dbus.socket dev-hugepages.mount dev-mqueue.mount sys-kernel-debug.mount sys-kernel-tracing.mount \
    modprobe@{configfs,dm_mod,drm,efi_pstore,fuse,loop}.service \
    proc-sys-fs-binfmt_misc.automount proc-sys-fs-binfmt_misc.mount systemd-binfmt.service; do
    ln -sf /dev/null "$root/etc/systemd/system/$unit"
done
echo guest > "$root/etc/hostname"
: > "$root/etc/machine-id"
: > "$root/etc/fstab"
chroot "$root" passwd -d root >&2
rm "$root"/etc/dpkg/dpkg.cfg.d/*mmdebstrap # what is installed later is installed whole
rm -rf "$root"/usr/share/{zoneinfo,bash-completion,perl,locale,gcc} "$root"/usr/lib/x86_64-linux-gnu/{gconv,perl*} \
    "$root"/usr/lib/python3*/{test,lib2to3} "$root"/var/cache/debconf/* "$root"/var/cache/apt/* "$root"/var/lib/apt/lists/* "$root"/boot/* "$root"/dev/*

truncate -s 1500M "$work/root.ext4"
mke2fs -q -F -t ext4 -O ^has_journal -d "$root" "$work/root.ext4"
mv "$work"/{vmlinuz,initrd,root.ext4} "$out/"
