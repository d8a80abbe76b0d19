// Package packettest tests the enforcer with real packets: two nodes, their pods and a host outside, each in a network
// namespace of its own, the enforcers of both nodes, and an API held in memory. It needs root, iproute2, util-linux and
// nftables; without root it is skipped.
package packettest
