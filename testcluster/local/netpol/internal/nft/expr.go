package nft

import (
	"encoding/binary"

	"golang.org/x/sys/unix"
)

// Keys of the ct expression that golang.org/x/sys does not name (linux/netfilter/nf_tables.h, since 4.17).
const (
	ctSrcIP  = 19
	ctSrcIP6 = 21
)

// Direction of a connection's tuple.
type Direction uint8

const (
	Original Direction = 0
	Reply    Direction = 1
)

// Register holds a value between expressions; concatenated values lie in consecutive 32-bit registers.
type Register uint32

// The registers as the kernel reports them: one that begins a 128-bit register is numbered as that register.
const (
	Verdict Register = unix.NFT_REG_VERDICT
	R0      Register = unix.NFT_REG_1
	R1      Register = unix.NFT_REG32_01
	R2      Register = unix.NFT_REG32_02
	R4      Register = unix.NFT_REG_2
	R5      Register = unix.NFT_REG32_05
)

// Expr is one encoded expression of a rule.
type Expr []byte

func expression(name string, data attrs) Expr {
	var a attrs
	a.str(unix.NFTA_EXPR_NAME, name)
	a.nest(unix.NFTA_EXPR_DATA, data)
	return Expr(a)
}

func value(data []byte) attrs {
	var a attrs
	a.bytes(unix.NFTA_DATA_VALUE, data)
	return a
}

func ct(key uint32, into Register) attrs {
	var a attrs
	a.u32(unix.NFTA_CT_DREG, uint32(into))
	a.u32(unix.NFTA_CT_KEY, key)
	return a
}

func ctOf(key uint32, dir Direction, into Register) Expr {
	a := ct(key, into)
	a.u8(unix.NFTA_CT_DIRECTION, uint8(dir))
	return expression("ct", a)
}

// CtSource loads the source address of the connection's tuple. In the original direction this is who opened the
// connection; in the reply direction it is who really answers, that is the destination after any DNAT. A packet of another
// family, or without a connection, does not match the rule.
func CtSource(family Family, dir Direction, into Register) Expr {
	if family == IPv6 {
		return ctOf(ctSrcIP6, dir, into)
	}
	return ctOf(ctSrcIP, dir, into)
}

// CtSourcePort loads the source port of the connection's tuple (2 bytes).
func CtSourcePort(dir Direction, into Register) Expr { return ctOf(unix.NFT_CT_PROTO_SRC, dir, into) }

// CtProtocol loads the transport protocol of the connection (1 byte): for an ICMP error that of the connection it is about.
func CtProtocol(into Register) Expr { return expression("ct", ct(unix.NFT_CT_PROTOCOL, into)) }

// CtState loads the state bits of the packet's connection.
func CtState(into Register) Expr { return expression("ct", ct(unix.NFT_CT_STATE, into)) }

// Bits of CtState.
const (
	StateInvalid   uint32 = 1
	StateUntracked uint32 = 64
)

// CtStatus loads the status bits of the packet's connection; a packet without a connection does not match the rule.
func CtStatus(into Register) Expr { return expression("ct", ct(unix.NFT_CT_STATUS, into)) }

// StatusConfirmed is the bit of CtStatus that is set once a packet of the connection has passed all hooks.
const StatusConfirmed uint32 = 8

// AnyBit matches when the register, a number in host order, has one of the bits.
func AnyBit(reg Register, bits uint32) []Expr {
	var a attrs
	a.u32(unix.NFTA_BITWISE_SREG, uint32(reg))
	a.u32(unix.NFTA_BITWISE_DREG, uint32(reg))
	a.u32(unix.NFTA_BITWISE_LEN, 4)
	a.u32(nftaBitwiseOp, 0)
	a.nest(unix.NFTA_BITWISE_MASK, value(binary.NativeEndian.AppendUint32(nil, bits)))
	a.nest(unix.NFTA_BITWISE_XOR, value(make([]byte, 4)))
	return []Expr{expression("bitwise", a), compare(unix.NFT_CMP_NEQ, reg, make([]byte, 4))}
}

const nftaBitwiseOp = 6

func compare(op uint32, reg Register, data []byte) Expr {
	var a attrs
	a.u32(unix.NFTA_CMP_SREG, uint32(reg))
	a.u32(unix.NFTA_CMP_OP, op)
	a.nest(unix.NFTA_CMP_DATA, value(data))
	return expression("cmp", a)
}

// Equal matches when the register begins with data.
func Equal(reg Register, data []byte) Expr { return compare(unix.NFT_CMP_EQ, reg, data) }

// Between matches when from <= register <= to, as big-endian numbers of their common length.
func Between(reg Register, from, to []byte) Expr {
	var a attrs
	a.u32(unix.NFTA_RANGE_SREG, uint32(reg))
	a.u32(unix.NFTA_RANGE_OP, unix.NFT_RANGE_EQ)
	a.nest(unix.NFTA_RANGE_FROM_DATA, value(from))
	a.nest(unix.NFTA_RANGE_TO_DATA, value(to))
	return expression("range", a)
}

func lookup(set string, reg Register, dest *Register, flags uint32) Expr {
	var a attrs
	a.str(unix.NFTA_LOOKUP_SET, set)
	a.u32(unix.NFTA_LOOKUP_SREG, uint32(reg))
	if dest != nil {
		a.u32(unix.NFTA_LOOKUP_DREG, uint32(*dest))
	}
	a.u32(unix.NFTA_LOOKUP_FLAGS, flags)
	return expression("lookup", a)
}

// In matches when the set holds the register's value.
func In(set string, reg Register) Expr { return lookup(set, reg, nil, 0) }

// NotIn matches when the set does not hold the register's value.
func NotIn(set string, reg Register) Expr { return lookup(set, reg, nil, unix.NFT_LOOKUP_F_INV) }

// Dispatch looks the register's value up in a verdict map and does what it says; without an element the rule does not match.
func Dispatch(set string, reg Register) Expr {
	verdict := Verdict
	return lookup(set, reg, &verdict, 0)
}

func meta(key uint32, into Register) Expr {
	var a attrs
	a.u32(unix.NFTA_META_DREG, uint32(into))
	a.u32(unix.NFTA_META_KEY, key)
	return expression("meta", a)
}

// InputInterface loads the name of the interface the packet came by.
func InputInterface(into Register) Expr { return meta(unix.NFT_META_IIFNAME, into) }

// OutputInterface loads the name of the interface the packet leaves by.
func OutputInterface(into Register) Expr { return meta(unix.NFT_META_OIFNAME, into) }

// IsFamily matches packets of the family.
func IsFamily(family Family) []Expr {
	return []Expr{meta(unix.NFT_META_NFPROTO, R0), Equal(R0, []byte{byte(family)})}
}

func payload(offset, length uint32, into Register) Expr {
	var a attrs
	a.u32(unix.NFTA_PAYLOAD_DREG, uint32(into))
	a.u32(unix.NFTA_PAYLOAD_BASE, unix.NFT_PAYLOAD_NETWORK_HEADER)
	a.u32(unix.NFTA_PAYLOAD_OFFSET, offset)
	a.u32(unix.NFTA_PAYLOAD_LEN, length)
	return expression("payload", a)
}

// PacketSource loads the source address of the packet itself, PacketDestination its destination.
func PacketSource(family Family, into Register) Expr {
	if family == IPv6 {
		return payload(8, 16, into)
	}
	return payload(12, 4, into)
}

// PacketDestination loads the destination address of the packet itself.
func PacketDestination(family Family, into Register) Expr {
	if family == IPv6 {
		return payload(24, 16, into)
	}
	return payload(16, 4, into)
}

// Counter counts the packets that come this far.
func Counter() Expr {
	var a attrs
	a.bytes(unix.NFTA_COUNTER_BYTES, make([]byte, 8))
	a.bytes(unix.NFTA_COUNTER_PACKETS, make([]byte, 8))
	return expression("counter", a)
}

func verdictData(v Action) attrs {
	var inner attrs
	inner.u32(unix.NFTA_VERDICT_CODE, uint32(v.code))
	if v.Chain != "" {
		inner.str(unix.NFTA_VERDICT_CHAIN, v.Chain)
	}
	var a attrs
	a.nest(unix.NFTA_DATA_VERDICT, inner)
	return a
}

// Action is what becomes of a packet.
type Action struct {
	code  int32
	Chain string
}

var (
	Accept   = Action{code: 1} // NF_ACCEPT: this base chain is done with the packet, later ones still see it.
	Drop     = Action{code: 0}
	Continue = Action{code: unix.NFT_CONTINUE}
)

// Jump goes through a chain and comes back when no rule there decided.
func Jump(chain string) Action { return Action{unix.NFT_JUMP, chain} }

// Goto goes through a chain and does not come back to this one.
func Goto(chain string) Action { return Action{unix.NFT_GOTO, chain} }

// Do ends a rule with an action.
func Do(action Action) Expr {
	var a attrs
	a.u32(unix.NFTA_IMMEDIATE_DREG, uint32(Verdict))
	a.nest(unix.NFTA_IMMEDIATE_DATA, verdictData(action))
	return expression("immediate", a)
}
