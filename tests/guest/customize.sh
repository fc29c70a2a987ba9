#!/bin/bash
# customize.sh ROOT: called by mmdebstrap when all packages are there: a small initrd, an agent for the test, nothing else.
set -euo pipefail

root=$1
here=$(cd "$(dirname "$0")" && pwd)
conf=$root/etc/initramfs-tools
sed -i 's/^MODULES=.*/MODULES=list/; s/^COMPRESS=.*/COMPRESS=gzip/' "$conf/initramfs.conf"
printf '%s\n' virtio_pci virtio_blk ext4 crc32c_generic > "$conf/modules"
chroot "$root" update-initramfs -u >&2

install -m 755 "$here/agent.py" "$root/usr/local/sbin/guest-agent"
cat > "$root/etc/systemd/system/guest-agent.service" <<'UNIT'
[Unit]
Description=Commands of the test
After=systemd-udev-settle.service

[Service]
ExecStartPre=-/sbin/ip link set lo up
ExecStartPre=-/sbin/ip address add 10.0.2.15/24 dev eth0
ExecStartPre=-/sbin/ip link set eth0 up
ExecStart=/usr/local/sbin/guest-agent
Restart=always
OOMScoreAdjust=-1000

[Install]
WantedBy=multi-user.target
UNIT
ln -s ../guest-agent.service "$root/etc/systemd/system/multi-user.target.wants/guest-agent.service" 2>/dev/null ||
    { mkdir -p "$root/etc/systemd/system/multi-user.target.wants" &&
        ln -s ../guest-agent.service "$root/etc/systemd/system/multi-user.target.wants/guest-agent.service"; }
ln -sf /lib/systemd/system/multi-user.target "$root/etc/systemd/system/default.target"
for unit in apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer e2scrub_all.timer e2scrub_reap.service \
    fstrim.timer getty.target serial-getty@ttyS0.service systemd-timesyncd.service systemd-networkd-wait-online.service \
    systemd-random-seed.service systemd-update-utmp.service systemd-logind.service; do
    ln -sf /dev/null "$root/etc/systemd/system/$unit"
done
echo guest > "$root/etc/hostname"
: > "$root/etc/machine-id"
printf '/dev/vda / ext4 defaults 0 0\n' > "$root/etc/fstab"
chroot "$root" passwd -d root >&2
