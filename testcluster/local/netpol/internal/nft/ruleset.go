package nft

import (
	"bytes"

	"golang.org/x/sys/unix"
)

// Family of addresses, as netfilter numbers it.
type Family uint8

const (
	IPv4 Family = unix.NFPROTO_IPV4
	IPv6 Family = unix.NFPROTO_IPV6
)

// Type of a set's key, numbered as the nft tool numbers it so that its listing is readable.
type Type uint32

const (
	TypeAddress4 Type = 7
	TypeAddress6 Type = 8
	TypeProtocol Type = 12
	TypePort     Type = 13
)

func (t Type) size() uint32 {
	switch t {
	case TypeAddress4:
		return 4
	case TypeAddress6:
		return 16
	case TypeProtocol:
		return 1
	}
	return 2
}

// Ruleset is the whole content of one table: what the kernel holds, or what it should hold.
type Ruleset struct {
	Chains map[string]*Chain
	Sets   map[string]*Set
}

// NewRuleset returns an empty one.
func NewRuleset() *Ruleset {
	return &Ruleset{Chains: map[string]*Chain{}, Sets: map[string]*Set{}}
}

// Chain is a list of rules. With a Hook it is a base chain, which the kernel itself calls.
type Chain struct {
	Hook  *Hook
	Rules []Rule
}

// Hook says where a filter chain is called.
type Hook struct {
	Number   uint32
	Priority int32
	Dropping bool // its policy: what becomes of packets that no rule decides about
}

// Rule is a list of expressions, each of which must match for the next to be tried.
type Rule struct {
	Exprs   []Expr
	Comment string
}

// Set holds keys, or, as a map, keys with an action each. Elements are in the order of their keys' bytes, each key once.
type Set struct {
	Key      []Type
	Map      bool
	Elements []Element
}

// Element of a set or a map. The parts of a concatenated key are padded to 4 bytes each.
type Element struct {
	Key    string
	Action Action
}

func (r Rule) equal(other Rule) bool {
	if len(r.Exprs) != len(other.Exprs) || r.Comment != other.Comment {
		return false
	}
	for i := range r.Exprs {
		if !bytes.Equal(r.Exprs[i], other.Exprs[i]) && !sameExpr(r.Exprs[i], other.Exprs[i]) {
			return false
		}
	}
	return true
}

func (c *Chain) equal(other *Chain) bool {
	if c == other {
		return true
	}
	if len(c.Rules) != len(other.Rules) || !c.sameHook(other) {
		return false
	}
	for i := range c.Rules {
		if !c.Rules[i].equal(other.Rules[i]) {
			return false
		}
	}
	return true
}

func (c *Chain) sameHook(other *Chain) bool {
	return (c.Hook == nil) == (other.Hook == nil) && (c.Hook == nil || *c.Hook == *other.Hook)
}

func (s *Set) sameType(other *Set) bool {
	if s.Map != other.Map || len(s.Key) != len(other.Key) {
		return false
	}
	for i := range s.Key {
		if s.Key[i] != other.Key[i] {
			return false
		}
	}
	return true
}

// sameExpr compares what two encoded expressions mean: the kernel's own dump of an expression may differ from what was
// sent in flag bits, and a counter's numbers are no part of the rule.
func sameExpr(a, b []byte) bool {
	name, left, okLeft := splitExpr(a)
	other, right, okRight := splitExpr(b)
	if !okLeft || !okRight || name != other {
		return false
	}
	return name == "counter" || sameAttrs(left, right, name)
}

func splitExpr(data []byte) (name string, body []byte, ok bool) {
	for _, a := range decode(data) {
		switch a.kind {
		case unix.NFTA_EXPR_NAME:
			name, ok = cstring(a.data), true
		case unix.NFTA_EXPR_DATA:
			body = a.data
		}
	}
	return name, body, ok
}

// nested lists, per expression, the attributes that hold attributes; all others are compared byte by byte.
var nested = map[string]map[uint16]bool{
	"cmp":       {unix.NFTA_CMP_DATA: true},
	"range":     {unix.NFTA_RANGE_FROM_DATA: true, unix.NFTA_RANGE_TO_DATA: true},
	"bitwise":   {unix.NFTA_BITWISE_MASK: true, unix.NFTA_BITWISE_XOR: true},
	"immediate": {unix.NFTA_IMMEDIATE_DATA: true},
	"data":      {unix.NFTA_DATA_VERDICT: true},
	"verdict":   {},
}

func sameAttrs(a, b []byte, scope string) bool {
	left, right := decode(a), decode(b)
	if len(left) != len(right) {
		return false
	}
	byKind := make(map[uint16][]byte, len(right))
	for _, attr := range right {
		byKind[attr.kind] = attr.data
	}
	for _, attr := range left {
		other, found := byKind[attr.kind]
		if !found {
			return false
		}
		if nested[scope][attr.kind] {
			inner := "data"
			if scope == "data" {
				inner = "verdict"
			}
			if !sameAttrs(attr.data, other, inner) {
				return false
			}
		} else if !bytes.Equal(attr.data, other) {
			return false
		}
	}
	return true
}
