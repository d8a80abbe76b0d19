// Package nft speaks the nf_tables netlink protocol, as far as the enforcer needs it: one table, its chains, rules, sets
// and maps, changed by atomic batches and read back by dumps.
//
// It exists because the two ready-made ways do not fit. `nft -f` forks, parses and resolves names (several milliseconds,
// on the path whose latency is measured), and the Go libraries cannot write the expression this enforcer is built on, the
// address of a connection's tuple in a table of family inet (NFT_CT_SRC_IP with a direction).
package nft

import (
	"encoding/binary"

	"golang.org/x/sys/unix"
)

// attrs builds a list of netlink attributes. Numbers are big endian, as nf_tables wants them.
type attrs []byte

func (a *attrs) bytes(kind uint16, data []byte) {
	length := unix.NLA_HDRLEN + len(data)
	*a = binary.NativeEndian.AppendUint16(*a, uint16(length))
	*a = binary.NativeEndian.AppendUint16(*a, kind)
	*a = append(*a, data...)
	*a = append(*a, make([]byte, align4(length)-length)...)
}

func (a *attrs) u8(kind uint16, value uint8) { a.bytes(kind, []byte{value}) }

func (a *attrs) u32(kind uint16, value uint32) {
	a.bytes(kind, binary.BigEndian.AppendUint32(nil, value))
}

func (a *attrs) str(kind uint16, value string) { a.bytes(kind, append([]byte(value), 0)) }

func (a *attrs) nest(kind uint16, inner attrs) { a.bytes(kind|unix.NLA_F_NESTED, inner) }

func align4(n int) int { return (n + 3) &^ 3 }

// attr is one decoded attribute; its kind is without the flag bits.
type attr struct {
	kind uint16
	data []byte
}

// decode splits a list of attributes; it ends at the first malformed one.
func decode(data []byte) []attr {
	var list []attr
	for len(data) >= unix.NLA_HDRLEN {
		length := int(binary.NativeEndian.Uint16(data))
		if length < unix.NLA_HDRLEN || length > len(data) {
			break
		}
		kind := binary.NativeEndian.Uint16(data[2:]) &^ (unix.NLA_F_NESTED | unix.NLA_F_NET_BYTEORDER)
		list = append(list, attr{kind, data[unix.NLA_HDRLEN:length]})
		data = data[min(align4(length), len(data)):]
	}
	return list
}

func cstring(data []byte) string {
	for i, b := range data {
		if b == 0 {
			return string(data[:i])
		}
	}
	return string(data)
}
