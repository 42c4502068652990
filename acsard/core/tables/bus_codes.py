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

# Why a TLS endpoint cannot be reached.
TlsCode = Literal[
    "tls_no_answer", "tls_no_name", "tls_no_route", "tls_no_program", "tls_handshake_hangs",
    "tls_closed", "tls_server_expired", "tls_server_early", "tls_server_other_name",
    "tls_server_not_signed", "tls_server_invalid", "tls_own_expired", "tls_own_refused",
    "tls_not_spoken",
]  # fmt: skip

BUS = table(
    Literal[BusCode, TlsCode],
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
FAIL tls_no_answer
    {host} does not answer on port {port}:
    -> is {host} switched on, and does a firewall drop connections?
FAIL tls_no_name
    the name {host} does not resolve on this machine
    -> write the robot's IP address (`hostname -I` on the robot prints it; the robot's certificate
    must contain this address), or fix DNS, mDNS or /etc/hosts
FAIL tls_no_route
    {host} cannot be reached ({reason}):
    -> is {host} switched on, is it in this network, is the address right?
FAIL tls_no_program
    no program listens on port {port} of {host} ({reason})
    -> if a router should: is it running? If a robot should: does bus.listen in its acsard.toml
    contain this address?
FAIL tls_handshake_hangs
    {host} accepts the connection to port {port}, but does not answer the TLS handshake:
    -> restart it
FAIL tls_closed
    {host} closes the connection to port {port} immediately:
    -> does a TLS endpoint of acsard listen there?
FAIL tls_server_expired
    the certificate of {host} has expired, according to this machine's clock ({now})
    -> if the clock is right, {renew}
FAIL tls_server_early
    the certificate of {host} is not valid yet, according to this machine's clock ({now})
    -> either correct this machine's clock (`timedatectl`), or correct the clock of the machine that
    made the certificate and then renew the certificate
FAIL tls_server_other_name
    the certificate of the server is not for {host}
    -> connect to a name or address that the certificate contains, or run `acsard tls renew
    --address {host}` on the robot; the command says what to do next
FAIL tls_server_not_signed
    the authority in {directory}/{ca} did not sign the certificate of {host} ({reason})
    -> use a certificate directory that `acsard tls add` made for this robot
FAIL tls_server_invalid
    the certificate of {host} is not valid ({reason})
    -> to make another one, {renew}
FAIL tls_own_expired
    {host} says that {certificate} has expired or is not valid yet:
    -> if the clocks of this machine and of that host are right (`timedatectl`), {renew}
FAIL tls_own_refused
    {host} does not accept {certificate} ({reason}), for example because the robot's authority did
    not sign it
    -> get one that `acsard tls add` made for this robot
FAIL tls_not_spoken
    {host} does not speak TLS on port {port} ({reason})
    -> an endpoint without TLS begins with tcp/
""",
)
