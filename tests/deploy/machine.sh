#!/usr/bin/env bash
# A machine of its own: systemd as PID 1, on a copy of this file system that is thrown away. `machine.py` runs it in new
# namespaces (mounts, hostname, IPC, control groups), with the folder of the machine.
set -euo pipefail
folder=$1 project=$2 packages=$3 python=$4 installed=$5
root=$folder/root
mount --make-rprivate /
mkdir -p "$root" "$folder/layer"
mount -t tmpfs tmpfs "$folder/layer"
mkdir "$folder/layer/upper" "$folder/layer/work"
mount -t overlay overlay -o "lowerdir=/,upperdir=$folder/layer/upper,workdir=$folder/layer/work" "$root"
mount --rbind /dev "$root/dev"
mount -t sysfs sysfs "$root/sys"
mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"
mount -t tmpfs -o mode=755 tmpfs "$root/run"
mount -t tmpfs -o mode=1777 tmpfs "$root/tmp"

# Nothing of this machine's own starts there.
rm -rf "$root"/etc/systemd/system/* "$root"/lib/systemd/system/*.wants "$root"/lib/systemd/system-generators/*
for target in sysinit basic network-online; do
  printf '[Unit]\nDefaultDependencies=no\n' >"$root/etc/systemd/system/$target.target"
done
printf '[Unit]\nDefaultDependencies=no\nAllowIsolate=yes\n' >"$root/etc/systemd/system/machine.target"
mkdir "$root/etc/systemd/system/service.d"
cat >"$root/etc/systemd/system/service.d/machine.conf" <<'EOF'
[Service]
StandardOutput=append:/var/log/zscout.log
StandardError=append:/var/log/zscout.log
# Where Python's own library was, the unit sees nothing.
Environment=LD_LIBRARY_PATH=/opt/zscout/python/lib
EOF

# The unit sees neither /root, /home nor /tmp, where any of these may be.
mkdir -p "$root"/opt/zscout/{project,packages,python}
mount --bind "$project" "$root/opt/zscout/project"
mount --bind "$packages" "$root/opt/zscout/packages"
mount --bind "$python" "$root/opt/zscout/python"
if [ "$installed" = yes ]; then
  cp "$project"/deploy/systemd/* "$root/etc/systemd/system/"
  systemd-sysusers --root="$root" "$project/deploy/sysusers.d/zscout.conf"
  mkdir -p "$root/opt/zscout/current/bin" "$root/etc/zscout/keys"
  cp "$project/deploy/renew-certificate" "$root/etc/zscout/"
  for program in zscout-node=zscout.node zscout=zscout.cli.main; do
    cat >"$root/opt/zscout/current/bin/${program%=*}" <<EOF
#!/bin/sh
export PYTHONPATH=/opt/zscout/project:/opt/zscout/packages PYTHONDONTWRITEBYTECODE=1
exec /opt/zscout/python/bin/python3 -m ${program#*=} "\$@"
EOF
    chmod 755 "$root/opt/zscout/current/bin/${program%=*}"
  done
fi

# shellcheck disable=SC2016 # it is for the inner shell
exec unshare --pid --fork --kill-child chroot "$root" /bin/sh -c '
  mount -t proc proc /proc && mount --bind /proc/sys /proc/sys && mount -o remount,ro,bind /proc/sys
  export container=zscout
  exec /lib/systemd/systemd --system --unit=machine.target --log-target=console --show-status=no'
