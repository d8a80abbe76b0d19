"""What is flooded: the ports of pods, from what the kernel shows of their sockets."""

from __future__ import annotations

from bench.flood.targets import receiving, udp_counters

SOCKETS = """\
   sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode ref pointer drops
  170: 00000000:1F0E 00000000:0000 07 00000000:00000000 00:00000000 00000000 65532        0 1111 2 0000000000000000 0
  171: 00000000:1CF2 00000000:0000 07 00000000:00000000 00:00000000 00000000 65532        0 1112 2 0000000000000000 0
  172: 0502C612:9C40 00000000:0000 07 00000000:00000000 00:00000000 00000000 65532        0 1113 2 0000000000000000 0
"""

COUNTERS = """\
Tcp: RtoAlgorithm RtoMin
Tcp: 1 200
Udp: InDatagrams NoPorts InErrors OutDatagrams RcvbufErrors SndbufErrors
Udp: 1200 3 40 900 39 0
UdpLite: InDatagrams
UdpLite: 0
"""


def test_ports_of_senders_are_left_out() -> None:
    assert receiving(SOCKETS) == [7410, 7950]


def test_counters_of_datagrams() -> None:
    found = udp_counters(COUNTERS)
    assert (found["InDatagrams"], found["RcvbufErrors"]) == (1200, 39)
