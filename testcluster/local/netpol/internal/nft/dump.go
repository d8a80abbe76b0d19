package nft

import (
	"encoding/binary"
	"errors"
	"fmt"
	"slices"
	"strings"

	"golang.org/x/sys/unix"
)

// ErrChanging says that rules were changed while they were being read; reading again may succeed.
var ErrChanging = errors.New("nf_tables changed during the dump")

// Dump reads the table's content; nil when there is no such table.
func (c *Conn) Dump(table string) (*Ruleset, error) {
	found := false
	err := c.dump(unix.NFT_MSG_GETTABLE, nil, func(a map[uint16][]byte) {
		found = found || cstring(a[unix.NFTA_TABLE_NAME]) == table
	})
	if err != nil || !found {
		return nil, err
	}
	set := NewRuleset()
	if err := c.dumpChains(table, set); err != nil {
		return nil, err
	}
	return set, c.dumpSets(table, set)
}

func (c *Conn) dumpChains(table string, into *Ruleset) error {
	err := c.dump(unix.NFT_MSG_GETCHAIN, nil, func(a map[uint16][]byte) {
		if cstring(a[unix.NFTA_CHAIN_TABLE]) != table {
			return
		}
		chain := &Chain{}
		if hook, based := a[unix.NFTA_CHAIN_HOOK]; based {
			h := index(hook)
			chain.Hook = &Hook{Number: number(h[unix.NFTA_HOOK_HOOKNUM]), Priority: int32(number(h[unix.NFTA_HOOK_PRIORITY])),
				Dropping: number(a[unix.NFTA_CHAIN_POLICY]) == uint32(Drop.code)}
		}
		into.Chains[cstring(a[unix.NFTA_CHAIN_NAME])] = chain
	})
	if err != nil {
		return err
	}
	var filter attrs
	filter.str(unix.NFTA_RULE_TABLE, table)
	return c.dump(unix.NFT_MSG_GETRULE, filter, func(a map[uint16][]byte) {
		chain := into.Chains[cstring(a[unix.NFTA_RULE_CHAIN])]
		if chain == nil || cstring(a[unix.NFTA_RULE_TABLE]) != table {
			return
		}
		rule := Rule{}
		for _, e := range decode(a[unix.NFTA_RULE_EXPRESSIONS]) {
			rule.Exprs = append(rule.Exprs, Expr(e.data))
		}
		if data := a[unix.NFTA_RULE_USERDATA]; len(data) > 2 && data[0] == 0 {
			rule.Comment = cstring(data[2:])
		}
		chain.Rules = append(chain.Rules, rule)
	})
}

func (c *Conn) dumpSets(table string, into *Ruleset) error {
	var filter attrs
	filter.str(unix.NFTA_SET_TABLE, table)
	err := c.dump(unix.NFT_MSG_GETSET, filter, func(a map[uint16][]byte) {
		if cstring(a[unix.NFTA_SET_TABLE]) != table {
			return
		}
		set := &Set{Map: number(a[unix.NFTA_SET_FLAGS])&unix.NFT_SET_MAP != 0}
		for key := number(a[unix.NFTA_SET_KEY_TYPE]); key != 0; key >>= 6 {
			set.Key = append(set.Key, Type(key&63))
		}
		slices.Reverse(set.Key)
		into.Sets[cstring(a[unix.NFTA_SET_NAME])] = set
	})
	if err != nil {
		return err
	}
	for name, set := range into.Sets {
		var one attrs
		one.str(unix.NFTA_SET_ELEM_LIST_TABLE, table)
		one.str(unix.NFTA_SET_ELEM_LIST_SET, name)
		err := c.dump(unix.NFT_MSG_GETSETELEM, one, func(a map[uint16][]byte) {
			for _, element := range decode(a[unix.NFTA_SET_ELEM_LIST_ELEMENTS]) {
				set.Elements = append(set.Elements, decodeElement(element.data))
			}
		})
		if err != nil {
			return err
		}
		slices.SortFunc(set.Elements, func(a, b Element) int { return strings.Compare(a.Key, b.Key) })
	}
	return nil
}

func decodeElement(data []byte) Element {
	fields := index(data)
	element := Element{Key: string(index(fields[unix.NFTA_SET_ELEM_KEY])[unix.NFTA_DATA_VALUE])}
	if data, mapped := fields[unix.NFTA_SET_ELEM_DATA]; mapped {
		verdict := index(index(data)[unix.NFTA_DATA_VERDICT])
		element.Action = Action{int32(number(verdict[unix.NFTA_VERDICT_CODE])), cstring(verdict[unix.NFTA_VERDICT_CHAIN])}
	}
	return element
}

func index(data []byte) map[uint16][]byte {
	fields := map[uint16][]byte{}
	for _, a := range decode(data) {
		fields[a.kind] = a.data
	}
	return fields
}

func number(data []byte) uint32 {
	if len(data) != 4 {
		return 0
	}
	return binary.BigEndian.Uint32(data)
}

func (c *Conn) dump(kind uint16, filter attrs, f func(map[uint16][]byte)) error {
	c.seq++
	asked := c.seq
	flags := uint16(unix.NLM_F_REQUEST | unix.NLM_F_DUMP)
	request := appendMessage(nil, unix.NFNL_SUBSYS_NFTABLES<<8|kind, flags, asked, unix.NFPROTO_INET, 0, filter)
	if err := unix.Sendto(c.fd, request, 0, &unix.SockaddrNetlink{Family: unix.AF_NETLINK}); err != nil {
		return fmt.Errorf("asking nf_tables for a dump: %w", err)
	}
	var failure error
	for done := false; !done; {
		err := c.each(func(kind uint16, seq uint32, flags uint16, body []byte) {
			if seq != asked {
				return
			}
			if flags&unix.NLM_F_DUMP_INTR != 0 {
				failure = ErrChanging
			}
			switch kind {
			case unix.NLMSG_DONE:
				done = true
			case unix.NLMSG_ERROR:
				done = true
				if errno := unix.Errno(-int32(binary.NativeEndian.Uint32(body))); errno != 0 {
					failure = errno
				}
			default:
				// The receive buffer is used again: what is kept must be copied.
				f(index(slices.Clone(body[4:])))
			}
		})
		if err != nil {
			return fmt.Errorf("reading a dump of nf_tables: %w", err)
		}
	}
	return failure
}
