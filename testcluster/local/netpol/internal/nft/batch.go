package nft

import (
	"encoding/binary"
	"fmt"
	"maps"
	"slices"

	"golang.org/x/sys/unix"
)

// Batch is a list of changes to one table that the kernel makes all at once or not at all.
type Batch struct {
	table    string
	messages []message
	Changes  Changes
}

// Changes counts what a batch does.
type Changes struct {
	Full            bool `json:"full,omitempty"`
	ChainsAdded     int  `json:"chainsAdded,omitempty"`
	ChainsRemoved   int  `json:"chainsRemoved,omitempty"`
	Rules           int  `json:"rules,omitempty"`
	SetsAdded       int  `json:"setsAdded,omitempty"`
	SetsRemoved     int  `json:"setsRemoved,omitempty"`
	ElementsAdded   int  `json:"elementsAdded,omitempty"`
	ElementsRemoved int  `json:"elementsRemoved,omitempty"`
}

type message struct {
	kind  uint16
	flags uint16
	body  attrs
	about string // for errors
}

// elementBytes bounds one list of elements: the length of a netlink attribute is a 16-bit number.
const elementBytes = 48 << 10

// Empty reports whether there is nothing to do.
func (b *Batch) Empty() bool { return len(b.messages) == 0 }

// Replace makes a batch after which the table holds exactly `want`, whatever it held before, or whether it was there.
func Replace(table string, want *Ruleset) *Batch {
	b := Remove(table)
	b.Changes.Full = true
	b.addTable()
	b.change(NewRuleset(), want)
	return b
}

// Remove makes a batch after which the table is gone, whether it was there or not.
func Remove(table string) *Batch {
	b := &Batch{table: table}
	b.addTable() // deleting what is not there would be an error
	var a attrs
	a.str(unix.NFTA_TABLE_NAME, table)
	b.add(unix.NFT_MSG_DELTABLE, 0, a, "table "+table)
	return b
}

// Update makes a batch that turns the table's content from `have`, nil when nothing is known of it, into `want`. What is
// already right is not touched: no packet on its way is judged by half of the old and half of the new.
func Update(table string, have, want *Ruleset) *Batch {
	if have == nil || !have.adaptable(want) {
		return Replace(table, want)
	}
	b := &Batch{table: table}
	b.change(have, want)
	return b
}

// adaptable reports whether everything that has the same name is of the same type and at the same hook: these cannot be changed.
func (r *Ruleset) adaptable(want *Ruleset) bool {
	for name, set := range want.Sets {
		if old := r.Sets[name]; old != nil && old != set && !old.sameType(set) {
			return false
		}
	}
	for name, chain := range want.Chains {
		if old := r.Chains[name]; old != nil && old != chain && !old.sameHook(chain) {
			return false
		}
	}
	return true
}

func (b *Batch) add(kind, flags uint16, body attrs, about string) {
	b.messages = append(b.messages, message{kind, flags, body, about})
}

func (b *Batch) addTable() {
	var a attrs
	a.str(unix.NFTA_TABLE_NAME, b.table)
	a.u32(unix.NFTA_TABLE_FLAGS, 0)
	b.add(unix.NFT_MSG_NEWTABLE, unix.NLM_F_CREATE, a, "table "+b.table)
}

// change orders the messages so that whatever one names is there when it is handled: what is new first, then the elements,
// then what nothing names any more.
func (b *Batch) change(have, want *Ruleset) {
	var newSets, newChains, rewrite, oldSets, oldChains []string
	for name := range want.Sets {
		if have.Sets[name] == nil {
			newSets = append(newSets, name)
		}
	}
	for name, chain := range want.Chains {
		old := have.Chains[name]
		switch {
		case old == nil:
			newChains = append(newChains, name)
		case !old.equal(chain):
			rewrite = append(rewrite, name)
		}
	}
	for name := range have.Sets {
		if want.Sets[name] == nil {
			oldSets = append(oldSets, name)
		}
	}
	for name := range have.Chains {
		if want.Chains[name] == nil {
			oldChains = append(oldChains, name)
		}
	}
	for _, list := range [][]string{newSets, newChains, rewrite, oldSets, oldChains} {
		slices.Sort(list)
	}

	for i, name := range newSets {
		b.newSet(name, want.Sets[name], uint32(i+1))
	}
	for _, name := range newChains {
		b.newChain(name, want.Chains[name])
	}
	for _, name := range rewrite {
		b.flush(name)
	}
	for _, name := range slices.Concat(newChains, rewrite) {
		for i, rule := range want.Chains[name].Rules {
			b.newRule(name, rule, i)
		}
	}
	for _, name := range slices.Sorted(maps.Keys(want.Sets)) {
		old := have.Sets[name]
		if old == nil {
			old = &Set{}
		}
		if old != want.Sets[name] {
			b.elements(name, old.Elements, want.Sets[name])
		}
	}
	// A chain can only be deleted when no rule and no element points to it.
	for _, name := range oldSets {
		if have.Sets[name].Map {
			b.elements(name, have.Sets[name].Elements, &Set{Map: true})
		}
	}
	for _, name := range oldChains {
		b.flush(name)
	}
	for _, name := range oldChains {
		b.deleteChain(name)
	}
	for _, name := range oldSets {
		b.deleteSet(name)
	}
}

func (b *Batch) newSet(name string, set *Set, id uint32) {
	flags, keyType, keyLen := uint32(0), Type(0), uint32(0)
	for _, part := range set.Key {
		keyType = keyType<<6 | part
		if len(set.Key) == 1 {
			keyLen = part.size()
		} else {
			keyLen += uint32(align4(int(part.size())))
		}
	}
	if len(set.Key) > 1 {
		flags |= nftSetConcat
	}
	var a attrs
	a.str(unix.NFTA_SET_TABLE, b.table)
	a.str(unix.NFTA_SET_NAME, name)
	if set.Map {
		flags |= unix.NFT_SET_MAP
	}
	a.u32(unix.NFTA_SET_FLAGS, flags)
	a.u32(unix.NFTA_SET_KEY_TYPE, uint32(keyType))
	a.u32(unix.NFTA_SET_KEY_LEN, keyLen)
	if set.Map {
		a.u32(unix.NFTA_SET_DATA_TYPE, unix.NFT_DATA_VERDICT)
	}
	a.u32(unix.NFTA_SET_ID, id)
	if len(set.Key) > 1 {
		var fields attrs
		for _, part := range set.Key {
			var field attrs
			field.u32(1, part.size()) // NFTA_SET_FIELD_LEN
			fields.nest(unix.NFTA_LIST_ELEM, field)
		}
		var desc attrs
		desc.nest(nftaSetDescConcat, fields)
		a.nest(unix.NFTA_SET_DESC, desc)
	}
	b.add(unix.NFT_MSG_NEWSET, unix.NLM_F_CREATE, a, "set "+name)
	b.Changes.SetsAdded++
}

const (
	nftSetConcat      = 0x80 // NFT_SET_CONCAT
	nftaSetDescConcat = 2    // NFTA_SET_DESC_CONCAT
)

func (b *Batch) newChain(name string, chain *Chain) {
	var a attrs
	a.str(unix.NFTA_CHAIN_TABLE, b.table)
	a.str(unix.NFTA_CHAIN_NAME, name)
	if chain.Hook != nil {
		var hook attrs
		hook.u32(unix.NFTA_HOOK_HOOKNUM, chain.Hook.Number)
		hook.u32(unix.NFTA_HOOK_PRIORITY, uint32(chain.Hook.Priority))
		a.nest(unix.NFTA_CHAIN_HOOK, hook)
		policy := Accept
		if chain.Hook.Dropping {
			policy = Drop
		}
		a.u32(unix.NFTA_CHAIN_POLICY, uint32(policy.code))
		a.str(unix.NFTA_CHAIN_TYPE, "filter")
	}
	b.add(unix.NFT_MSG_NEWCHAIN, unix.NLM_F_CREATE, a, "chain "+name)
	b.Changes.ChainsAdded++
}

func (b *Batch) newRule(chain string, rule Rule, position int) {
	var list attrs
	for _, expr := range rule.Exprs {
		list.nest(unix.NFTA_LIST_ELEM, attrs(expr))
	}
	var a attrs
	a.str(unix.NFTA_RULE_TABLE, b.table)
	a.str(unix.NFTA_RULE_CHAIN, chain)
	a.nest(unix.NFTA_RULE_EXPRESSIONS, list)
	if rule.Comment != "" {
		a.bytes(unix.NFTA_RULE_USERDATA, userComment(rule.Comment))
	}
	b.add(unix.NFT_MSG_NEWRULE, unix.NLM_F_CREATE|unix.NLM_F_APPEND, a, fmt.Sprintf("rule %d of chain %s", position, chain))
	b.Changes.Rules++
}

// userComment is how the nft tool stores a rule's comment: type 0, length, text with its zero byte.
func userComment(text string) []byte {
	text = text[:min(len(text), 127)]
	return append(append([]byte{0, byte(len(text) + 1)}, text...), 0)
}

func (b *Batch) flush(chain string) {
	var a attrs
	a.str(unix.NFTA_RULE_TABLE, b.table)
	a.str(unix.NFTA_RULE_CHAIN, chain)
	b.add(unix.NFT_MSG_DELRULE, 0, a, "rules of chain "+chain)
}

func (b *Batch) deleteChain(name string) {
	var a attrs
	a.str(unix.NFTA_CHAIN_TABLE, b.table)
	a.str(unix.NFTA_CHAIN_NAME, name)
	b.add(unix.NFT_MSG_DELCHAIN, 0, a, "deletion of chain "+name)
	b.Changes.ChainsRemoved++
}

func (b *Batch) deleteSet(name string) {
	var a attrs
	a.str(unix.NFTA_SET_TABLE, b.table)
	a.str(unix.NFTA_SET_NAME, name)
	b.add(unix.NFT_MSG_DELSET, 0, a, "deletion of set "+name)
	b.Changes.SetsRemoved++
}

// elements turns the sorted elements `have` of a set into those of `want`. An element whose action changes is deleted and
// added: within one batch no packet sees it missing.
func (b *Batch) elements(name string, have []Element, want *Set) {
	var gone, fresh []Element
	i, j := 0, 0
	for i < len(have) || j < len(want.Elements) {
		switch {
		case j == len(want.Elements) || (i < len(have) && have[i].Key < want.Elements[j].Key):
			gone = append(gone, have[i])
			i++
		case i == len(have) || want.Elements[j].Key < have[i].Key:
			fresh = append(fresh, want.Elements[j])
			j++
		default:
			if have[i].Action != want.Elements[j].Action {
				gone, fresh = append(gone, have[i]), append(fresh, want.Elements[j])
			}
			i, j = i+1, j+1
		}
	}
	b.elementMessages(unix.NFT_MSG_DELSETELEM, 0, name, gone, false)
	b.elementMessages(unix.NFT_MSG_NEWSETELEM, unix.NLM_F_CREATE|unix.NLM_F_EXCL, name, fresh, want.Map)
	b.Changes.ElementsRemoved += len(gone)
	b.Changes.ElementsAdded += len(fresh)
}

func (b *Batch) elementMessages(kind, flags uint16, set string, elements []Element, data bool) {
	for len(elements) > 0 {
		var list attrs
		n := 0
		for ; n < len(elements) && len(list) < elementBytes; n++ {
			var e attrs
			e.nest(unix.NFTA_SET_ELEM_KEY, value([]byte(elements[n].Key)))
			if data {
				e.nest(unix.NFTA_SET_ELEM_DATA, verdictData(elements[n].Action))
			}
			list.nest(unix.NFTA_LIST_ELEM, e)
		}
		var a attrs
		a.str(unix.NFTA_SET_ELEM_LIST_TABLE, b.table)
		a.str(unix.NFTA_SET_ELEM_LIST_SET, set)
		a.nest(unix.NFTA_SET_ELEM_LIST_ELEMENTS, list)
		b.add(kind, flags, a, fmt.Sprintf("%d elements of set %s", n, set))
		elements = elements[n:]
	}
}

// wire lays the batch out for one sendmsg. Only the last message asks for an acknowledgement: failing ones answer anyway,
// and one answer per message could overrun the socket's buffer.
func (b *Batch) wire(firstSeq uint32) []byte {
	out := appendMessage(nil, unix.NFNL_MSG_BATCH_BEGIN, unix.NLM_F_REQUEST, firstSeq, unix.AF_UNSPEC, unix.NFNL_SUBSYS_NFTABLES, nil)
	for i, m := range b.messages {
		flags := m.flags | unix.NLM_F_REQUEST
		if i == len(b.messages)-1 {
			flags |= unix.NLM_F_ACK
		}
		out = appendMessage(out, unix.NFNL_SUBSYS_NFTABLES<<8|m.kind, flags, firstSeq+1+uint32(i), unix.NFPROTO_INET, 0, m.body)
	}
	return appendMessage(out, unix.NFNL_MSG_BATCH_END, unix.NLM_F_REQUEST, firstSeq+1+uint32(len(b.messages)), unix.AF_UNSPEC, unix.NFNL_SUBSYS_NFTABLES, nil)
}

func appendMessage(out []byte, kind, flags uint16, seq uint32, family uint8, resource uint16, body attrs) []byte {
	length := unix.NLMSG_HDRLEN + 4 + len(body)
	out = binary.NativeEndian.AppendUint32(out, uint32(length))
	out = binary.NativeEndian.AppendUint16(out, kind)
	out = binary.NativeEndian.AppendUint16(out, flags)
	out = binary.NativeEndian.AppendUint32(out, seq)
	out = binary.NativeEndian.AppendUint32(out, 0) // port: the kernel's
	out = append(out, family, unix.NFNETLINK_V0)
	out = binary.BigEndian.AppendUint16(out, resource)
	out = append(out, body...)
	return append(out, make([]byte, align4(length)-length)...)
}
