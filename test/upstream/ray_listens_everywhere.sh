#!/usr/bin/env bash
# Where a cluster listens that ray.init() starts by itself on Linux, in one release.
#
# Expected, written down before the run: the cluster is for one machine, but its ports are open on
# every address; with RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER=0, whose name speaks of other systems, all
# of them are on the loopback address. It guards mtv_world_ros/core/ray_actors.py, which sets it.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check ray==2.60.0 psutil==7.2.2
for network in '' 0; do
    RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER=$network "$place/env/bin/python" - <<'PYTHON' 2>&1 | tail -1
import ipaddress
import os

if not os.environ['RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER']:
    del os.environ['RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER']
import psutil
import ray

ray.init(log_to_driver=False, include_dashboard=False, num_cpus=1)
hosts = set()
for process in psutil.Process().children(recursive=True):
    for connection in process.net_connections('tcp'):
        if connection.status == psutil.CONN_LISTEN:
            host = ipaddress.ip_address(connection.laddr.ip)
            hosts.add(getattr(host, 'ipv4_mapped', None) or host)
ray.shutdown()
local = all(host.is_loopback for host in hosts)
wanted = 'RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER' in os.environ
said = 'as before' if local == wanted else 'changed'
print(f'{said}: variable {"0" if wanted else "not set"}, on {sorted(map(str, hosts))}')
PYTHON
done | tee "$place/said"
! grep -q changed "$place/said" && test "$(grep -c 'as before' "$place/said")" = 2
