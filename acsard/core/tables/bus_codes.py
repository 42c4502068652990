"""The codes of the bus: the daemon, routers and the TLS gateway as seen from outside."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

BusCode = Literal[
    "daemon_answers", "daemon_elsewhere", "daemon_behind_router", "daemon_absent", "daemon_silent",
    "daemon_refuses", "daemon_other_version", "role_known", "routers_connected", "routers_due",
    "router_missing", "router_is_peer", "router_absent", "bus_open", "gateway_open",
    "gateway_absent",
]  # fmt: skip

BUS = table(
    BusCode,
    """
OK daemon: answers
    acsard {version}, pid {pid}
OK daemon: elsewhere
    the daemon runs on another machine: check its port, files and TLS gateway there
WARN daemon: behind router
    this tool reaches the daemon only through the Zenoh router at {endpoint}, and no program listens
    there
    -> start that router (rmw_zenohd, zenohd or `acsard router`), then run `acsard doctor` again;
    until then, `systemctl status acsard` shows the state of the daemon
WARN daemon: absent
    no program listens at {endpoint}
    -> if the daemon is a systemd service, `systemctl status acsard` shows why it does not run;
    otherwise start it with `acsard run`. If the daemon was started with --listen ADDRESS, give this
    command the same address with --connect{advice}
FAIL daemon: silent
    {error}
    -> if the daemon has another robot id, name that id with --id (`acsard fleet` lists the robots);
    otherwise check whether another program listens at that address
FAIL daemon: refuses
    {error}
FAIL daemon: other version
    {error}
    -> if the daemon has another version of acsard, run this tool from the same version
OK role: known
    {role}
OK routers_connected
    connected
OK routers_due
    not connected yet
WARN router_missing
    not connected to {routers}
    -> start the Zenoh router at that address (rmw_zenohd, zenohd or `acsard router`): the daemon
    then connects by itself
WARN router_is_peer
    {routers} is not a router: clients that connect to this daemon see only this robot
    -> connect all robots to a Zenoh router (page howto/fleet of the manual)
WARN router: absent
    no program listens at {endpoint}
    -> start the Zenoh router there (rmw_zenohd, zenohd or `acsard router`)
WARN bus: open
    the daemon connects to the router at {endpoint} without TLS: every program that is connected to
    that router has the rights of this machine
    -> let the router listen only on loopback, or let the daemon connect to it over TLS
OK gateway: open
    open at {endpoint}
WARN gateway: absent
    no program listens at {endpoint}
    -> `systemctl status acsard-gateway` shows why the TLS gateway does not run; without the systemd
    service, `acsard run` starts a gateway by itself
""",
)
