#!/bin/bash
# build_image.sh OUT_DIR: a small guest of the Debian release this runs on, with the stock kernel: vmlinuz, initrd.img and
# root.ext4. Needs root, mmdebstrap, mke2fs. What is on it besides systemd, udev and Python is put there by the test.
set -euo pipefail

out=$(mkdir -p "$1" && cd "$1" && pwd)
here=$(cd "$(dirname "$0")" && pwd)
work=$(mktemp -d "$out/build.XXXXXX")
root=$work/root
trap 'rm -rf "$work"' EXIT
release=$(. /etc/os-release && echo "$VERSION_CODENAME")
packages=systemd,systemd-sysv,udev,kmod,dbus,python3,iproute2,procps,util-linux,psmisc,linux-image-amd64
modules=(virtio_pci virtio_blk virtio_net virtio_rng ext4 crc32c_generic xhci_pci ftdi_sio cdc_acm)

mmdebstrap --quiet --mode=root --variant=minbase --include="$packages" \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
    --dpkgopt='path-exclude=/usr/share/locale/*' --aptopt='APT::Install-Recommends "false"' \
    --customize-hook="$here/customize.sh \"\$1\"" "$release" "$root" >&2

kernel=$(basename "$(echo "$root"/lib/modules/*)")
cp "$root/boot/vmlinuz-$kernel" "$out/vmlinuz"
cp "$root/boot/initrd.img-$kernel" "$out/initrd.img"

# of the kernel's modules only those that are needed, with what they depend on
mkdir -p "$work/kept/lib/modules/$kernel"
cp "$root/lib/modules/$kernel"/modules.{builtin,builtin.modinfo,order} "$work/kept/lib/modules/$kernel/"
for module in "${modules[@]}"; do
    modprobe --dirname "$root" --set-version "$kernel" --show-depends "$module" | awk '$1 == "insmod" { print $2 }'
done | sort -u | while read -r file; do
    install -D "$file" "$work/kept/${file#"$root"/}"
done
depmod --basedir "$work/kept" "$kernel"
rm -rf "$root/lib/modules" "$root"/boot/* "$root"/var/cache/apt/* "$root"/var/lib/apt/lists/*
cp -a "$work/kept/lib/modules" "$root/lib/modules"

truncate -s 1G "$work/root.ext4"
mke2fs -q -F -t ext4 -O ^has_journal -d "$root" "$work/root.ext4"
mv "$work/root.ext4" "$out/root.ext4"
