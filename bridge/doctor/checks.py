"""The table of everything that the doctor can find; docs/doctor.md explains the same table, and a test holds the two
together. Pure."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Severity(IntEnum):
    """How bad it is; the exit code of `macs doctor` comes from the worst."""

    OK = 0
    NOTE = 1
    WARNING = 2
    ERROR = 3


OK, NOTE, WARNING, ERROR = Severity


class Check(NamedTuple):
    """One thing that can be found."""

    group: str
    severity: Severity
    text: str
    """What was seen, to be filled in."""
    remedy: str = ""


GROUPS = ("routers", "tls", "access", "mesh", "programs", "settings")
"""In the order in which they are shown."""

RENEW = "renew it (macs security generate) and restart the program that shows it"
TRANSPORT = "transport/link/tls"

CHECKS: dict[str, Check] = {
    # -- routers -------------------------------------------------------------------------------------------------
    "router_ok": Check("routers", OK, "{version}, {round_trip} there and back{throughput}"),
    "no_endpoint": Check(
        "routers", ERROR, "the settings name no router", "give one: -e tcp/HOST:7447, or connect in [mesh]"
    ),
    "refused": Check("routers", ERROR, "nobody listens there", "start the router there, or correct host and port"),
    "silent": Check(
        "routers",
        ERROR,
        "{detail}",
        "see that the host is on, and that no firewall or NAT is in between: programs dial out to the router",
    ),
    "unknown_host": Check("routers", ERROR, "this host name is not known: {detail}", "correct the name, or the DNS"),
    "unreachable": Check(
        "routers", ERROR, "cannot be reached: {detail}", "see whether this machine has a route there"
    ),
    "session_refused": Check(
        "routers",
        ERROR,
        "the port answers, but no Zenoh session opens: {detail}",
        "wrong user or password (transport/auth/usrpwd), a router that takes no more sessions (max_sessions), or no "
        "Zenoh router at all; its log says which",
    ),
    "speaks_tls": Check("routers", ERROR, "this port speaks TLS", "write tls/… instead of tcp/…"),
    "admin_hidden": Check(
        "routers",
        NOTE,
        "the router tells nothing of itself: no version, no sessions, no links to other routers",
        "turn on adminspace/enabled there, and allow this program query and reply on @/*/router and @/*/router/**",
    ),
    "versions_differ": Check(
        "routers", WARNING, "different Zenoh versions: {versions}", "bring routers and programs to one version"
    ),
    "split": Check(
        "routers",
        ERROR,
        "not linked with {other}: who is behind one does not see who is behind the other",
        "let one of the two routers connect to the other: connect/endpoints in its configuration",
    ),
    "link_dead": Check(
        "routers",
        ERROR,
        "connected with router {other}, and nothing passes",
        "restart one of the two; `macs router` does so by itself when a link is back and carries nothing",
    ),
    "link_stale": Check(
        "routers",
        ERROR,
        "linked with {others}, and does not show {count} of those online there, as {one}",
        "restart one of the two (`macs router` does so by itself); if that does not help, compare their access rules",
    ),
    "slow": Check(
        "routers",
        NOTE,
        "{round_trip} there and back: that late is every command",
        "use a nearer router; robot and operator may be on different ones that are linked",
    ),
    "commands_wait": Check(
        "routers",
        WARNING,
        "what is put with the priority of commands may wait there where a link is full: a program that does so holds "
        "up everybody's commands and stops",
        "use `macs router`, or give it the rule of qos/network in config/router.json5; where `macs security generate` "
        "wrote its file, generate again",
    ),
    "large_dropped": Check(
        "routers",
        NOTE,
        "at about {throughput}, a stream message above {size} is dropped on the way",
        "raise fragment_wait_ms in [mesh] of the sender, or send smaller images",
    ),
    "is_gateway": Check(
        "routers",
        ERROR,
        "that is a gateway, where headsets connect",
        "name the router instead: {router}",
    ),
    "large_lost": Check(
        "routers",
        WARNING,
        "small messages arrive, one of {size} does not",
        "look for a wrong MTU on the way (VPN, tunnel), a low_pass_filter in a router, or a link that is full",
    ),
    "peers": Check(
        "routers",
        WARNING,
        "{count} programs in peer mode on one router do not hear each other: {who}",
        'make them clients: mode = "client" in their [mesh]',
    ),
    "peer": Check(
        "routers",
        NOTE,
        "one program in peer mode, {who}: a second one on this router would not hear it",
        'make it a client: mode = "client" in its [mesh]',
    ),
    "session_shared_memory": Check(
        "routers",
        WARNING,
        "implicit shared memory with {who}: large messages bypass the limits of queues, and can be lost in silence",
        "turn off transport/shared_memory/enabled there, or in the router",
    ),
    # -- TLS -----------------------------------------------------------------------------------------------------
    "tls_expired": Check("tls", ERROR, "the router's certificate has expired", RENEW),
    "tls_not_yet_valid": Check(
        "tls", ERROR, "the router's certificate is not valid yet", "set the clock here, or where it was made"
    ),
    "tls_unknown_ca": Check(
        "tls",
        ERROR,
        "the router's certificate is from a CA that these settings do not trust: {detail}",
        f"point root_ca_certificate ({TRANSPORT}) to the CA that signed it",
    ),
    "tls_wrong_name": Check(
        "tls",
        ERROR,
        "the router's certificate is for another host: {detail}",
        "connect by a name or address that is in the certificate, or make one with this name",
    ),
    "tls_client_certificate_missing": Check(
        "tls",
        ERROR,
        "the router wants a certificate of this program, and got none{hint}",
        f"set connect_certificate, connect_private_key and enable_mtls: true ({TRANSPORT})",
    ),
    "tls_client_certificate_refused": Check(
        "tls",
        ERROR,
        "the router refuses this program's certificate: {detail}",
        "use one from the CA that the router trusts, and not expired (macs security generate)",
    ),
    "tls_own_files": Check(
        "tls",
        ERROR,
        "our certificate, key or CA cannot be used: {detail}",
        f"correct the paths, or what is in the files ({TRANSPORT})",
    ),
    "tls_no_tls": Check("tls", ERROR, "no TLS there: {detail}", "write tcp/… instead of tls/…, or correct the port"),
    "tls_failed": Check("tls", ERROR, "the TLS handshake fails: {detail}", "see the router's log"),
    "mtls_off": Check(
        "tls",
        WARNING,
        "there is a client certificate, but it is not shown to routers",
        f"set enable_mtls: true ({TRANSPORT})",
    ),
    "certificate_ends": Check("tls", WARNING, "{subject} expires in {days} days", RENEW),
    "certificate_expired": Check("tls", ERROR, "{subject} has expired", RENEW),
    # -- access --------------------------------------------------------------------------------------------------
    "access_ok": Check("access", OK, "{who} may {tried}"),
    "presence_denied": Check(
        "access",
        ERROR,
        "{who} is not seen by others: its presence does not arrive",
        "allow it liveliness_token on ingress for {key}, and everybody liveliness_token on egress",
    ),
    "presence_unread": Check(
        "access",
        WARNING,
        "nobody is seen, not even a second session of this program",
        "if others are online, allow liveliness_query on ingress and liveliness_token on egress for macs/live/**",
    ),
    "presence_unwatched": Check(
        "access",
        ERROR,
        "who is online can be asked for, but changes are not told",
        "allow declare_liveliness_subscriber on ingress for macs/live/**",
    ),
    "lease_denied": Check(
        "access",
        ERROR,
        "{who} cannot lease its block, so another gateway may give out the same ids",
        "allow it liveliness_token on ingress for {key}",
    ),
    "inbox_denied": Check(
        "access",
        ERROR,
        "{who} does not hear what is sent to it",
        "allow it declare_subscriber on ingress and put on egress for {key}, everybody declare_subscriber on egress",
    ),
    "call_denied": Check(
        "access",
        WARNING,
        "{agent} is online, but does not answer calls of {who}",
        "unless that is meant to be: allow {who} query on ingress and reply on egress for macs/call/{agent}/**, and "
        "{agent} the opposite",
    ),
    "ping_denied": Check(
        "access",
        NOTE,
        "pings do not arrive, so clocks, throughput and the way to programs are unknown",
        "examine with an operator's settings, or allow macs/ping/* (put, query, reply, declare_subscriber, "
        "declare_queryable, in both flows)",
    ),
    # -- who is there --------------------------------------------------------------------------------------------
    "mesh_ok": Check("mesh", OK, "{agents} online, {gateways}; no id, block or name is taken twice"),
    "nobody": Check("mesh", NOTE, "nobody is online"),
    "block_twice": Check(
        "mesh",
        ERROR,
        "leased by {count} gateways, {who}: two headsets may get one id",
        "give each gateway a block of its own ([gateway] block) and restart one of them",
    ),
    "id_twice": Check(
        "mesh",
        ERROR,
        "online {count} times, sessions {who}: each gets a part of what is meant for the other",
        "stop one of them, or give it another id",
    ),
    "name_twice": Check(
        "mesh",
        ERROR,
        "this name is taken {count} times, sessions {who}",
        "give each robot a name of its own",
    ),
    "id_outside": Check(
        "mesh",
        WARNING,
        "it is outside of the blocks of its gateway {who} ({blocks}): messages to it do not arrive",
        "let the headset connect again; if that does not help, restart the gateway",
    ),
    "id_in_block": Check(
        "mesh",
        WARNING,
        "its id is in block {block}, from which gateway {gateway} gives out ids",
        "choose an id outside of leased blocks, or give the gateway another block",
    ),
    "other_namespace": Check(
        "mesh",
        NOTE,
        "{count} online in the namespace {namespace}",
        "if they belong to this mesh, use one --namespace everywhere",
    ),
    "wrong_namespace": Check(
        "mesh",
        WARNING,
        "nobody is online in the namespace {own}, but {count} in {namespace}",
        "use one --namespace everywhere",
    ),
    "ros_unnamed": Check(
        "mesh",
        NOTE,
        "{count} with rmw_zenoh and no session namespace: the keys do not say who sends",
        "give each robot's sessions a namespace, which access rules can hold it to (docs/rmw-zenoh.md)",
    ),
    # -- programs ------------------------------------------------------------------------------------------------
    "program_ok": Check("programs", OK, "macs-zenoh {macs}, {round_trip} there and back{throughput}, clock {clock}"),
    "program_silent": Check(
        "programs",
        WARNING,
        "it is online and does not answer a ping",
        "it hangs, it is older than macs doctor, or access rules keep macs/ping/* from it",
    ),
    "programs_left_out": Check("programs", NOTE, "{count} more were not pinged"),
    "clock_off": Check(
        "programs",
        WARNING,
        "its clock is {offset} {direction} ours",
        "synchronise both (chrony, PTP): times in sensor data are compared between machines",
    ),
    "macs_versions_differ": Check(
        "programs", WARNING, "different versions of macs-zenoh: {versions}", "bring them to one version"
    ),
    "slots_differ": Check(
        "programs",
        ERROR,
        "its frame headers have {theirs} slots for ids and groups, ours {ours}: neither can read the other",
        "set id_slots and group_slots in [mesh] to the same everywhere",
    ),
    "losses": Check("programs", NOTE, "it has lost messages since it started: {drops}", "its log says more"),
    "wrong_settings": Check(
        "programs",
        ERROR,
        "messages of its [[robot.rules]] do not fit the types of its graph: {count}",
        "its log names the topic and the field; until then headsets cannot command there",
    ),
    "no_stop": Check(
        "programs",
        ERROR,
        "it has no emergency stop: the topic of its settings has another type on its graph",
        "its log names both; set stop_topic to another topic, or give that one the type std_msgs/Bool",
    ),
    "shared_graph": Check(
        "programs",
        WARNING,
        "agents of {count} other robots work on its ROS graph: each drives what the other drives",
        "give each robot a ROS_DOMAIN_ID of its own",
    ),
    "in_trouble": Check("programs", WARNING, "at this moment: {now}", "its log says more"),
    "program_shared_memory": Check(
        "programs", WARNING, "implicit shared memory is on", "set shared_memory = false in its [mesh]"
    ),
    "program_peer": Check(
        "programs",
        WARNING,
        "it runs in mode {mode}: two peers on one router do not hear each other",
        'set mode = "client" in its [mesh]',
    ),
    # -- our settings --------------------------------------------------------------------------------------------
    "settings_ok": Check("settings", OK, "macs-zenoh {macs}, eclipse-zenoh {zenoh}, mode {mode}, lease {lease}"),
    "own_shared_memory": Check(
        "settings",
        WARNING,
        "implicit shared memory is on: large messages bypass the limits of queues, and can be lost in silence",
        "set shared_memory = false in [mesh], transport/shared_memory/enabled in Zenoh's file",
    ),
    "own_multicast": Check(
        "settings",
        NOTE,
        "multicast scouting is on: routers of other meshes may be found",
        "set multicast = false in [mesh]",
    ),
    "own_mode": Check(
        "settings",
        WARNING,
        "mode is {mode}: two peers on one router do not hear each other",
        'set mode = "client" in [mesh]',
    ),
    "lease_short": Check(
        "settings",
        WARNING,
        "a lease of {lease}: a short pause of the network looks like a lost host",
        "set lease_ms in [mesh] to 1000 to 10000",
    ),
    "lease_long": Check(
        "settings",
        WARNING,
        "a lease of {lease}: for so long a lost host is taken to be online",
        "set lease_ms in [mesh] to 1000 to 10000",
    ),
    "queue_long": Check(
        "settings",
        ERROR,
        "the queue for {name} is {size} batches long: above 16 Zenoh panics at its first link",
        "set tx_queue_batches in [mesh], or transport/link/tx/queue/size, to 16 at most",
    ),
    "close_long": Check(
        "settings",
        WARNING,
        "a link that takes nothing holds up the others for {wait}",
        "set block_limit_ms in [mesh] to 500 (congestion_control/block/wait_before_close)",
    ),
}
"""Every finding by its id."""
