// Package ruleset renders a policy model as nftables chains, sets and maps. It does no input or output.
//
// Every packet that is forwarded is judged, whatever the state of its connection, and always in the terms of the
// connection's first packet: who opened it (source of the original tuple), who really answers (source of the reply tuple,
// so after service translation) and on which port (source port of the reply tuple). So a reply needs no rule of its own,
// an ICMP error goes with the connection it is about, and an established flow ends with the first packet after its
// permission.
//
//	base chain egress   who opened it is a pod of this node?   -> its policies -> accept, or drop
//	base chain ingress  who answers is a pod of this node?     -> its policies -> accept, or drop
//
// There are two base chains, because an accept ends only its own chain. One element of a map (address -> the chain of its
// policies) decides what a pod may do. Chains never change their content (their name has a digest of it), and selectors
// are sets of addresses. So the usual change, another selector or another label, changes a few elements and no rule.
package ruleset

import (
	"crypto/sha256"
	"encoding/binary"
	"encoding/hex"
	"fmt"
	"net/netip"
	"slices"
	"strings"

	"golang.org/x/sys/unix"

	"understudy/testcluster/understudy-netpol/internal/nft"
	"understudy/testcluster/understudy-netpol/internal/policy"
)

// Table is the name of the only table, of family inet, which contains all of this.
const Table = "understudy_netpol"

// Names of the objects that are always there; those of one family end in 4 or 6.
const (
	localSet    = "local"    // addresses of all pods of this node
	isolatedSet = "isolated" // those a policy selects, in any direction
	selfSet     = "self"     // (a, a) for each of them: a pod can always reach itself
)

// Renderer turns models into rulesets. It remembers the last one's parts, since most parts of a model stay the same.
type Renderer struct {
	podInterfaces   string
	establishedLive bool
	memory
}

// memory has the rendered parts, by the part of the model that they were rendered from.
type memory struct {
	peers    map[partOf[*policy.Addresses]]*nft.Set
	names    map[partOf[*policy.Targets]]*nft.Set
	profiles map[profileKey]profile
	policies map[partOf[*policy.Rules]]*policyChains
}

type partOf[T any] struct {
	part   T
	family nft.Family
}

type profileKey struct {
	endpoint *policy.Endpoint
	side     string
	family   nft.Family
}

// profile is a chain shared by all pods that the same policies select.
type profile struct {
	name  string
	chain *nft.Chain
}

// policyChains is one direction of a policy, and the names of all that it refers to.
type policyChains struct {
	name   string
	chains map[string]*nft.Chain // its own and those of its rules' ports
	peers  map[string]policy.PeerID
	names  map[string]policy.PortName
}

func newMemory() memory {
	return memory{map[partOf[*policy.Addresses]]*nft.Set{}, map[partOf[*policy.Targets]]*nft.Set{}, map[profileKey]profile{}, map[partOf[*policy.Rules]]*policyChains{}}
}

// NewRenderer takes the prefix of the names of pods' interfaces. A packet that passes such an interface, but is neither
// from nor to a known pod, is dropped: its pod has just got its network, or its object was deleted by force while its
// processes still run. With an empty prefix such packets pass.
func NewRenderer(podInterfaces string) *Renderer {
	return &Renderer{podInterfaces: podInterfaces}
}

// LetEstablishedLive sets whether the flows live on of which a packet was let through before, whatever the policies say now.
// Flows of unknown pods end all the same.
func (r *Renderer) LetEstablishedLive(live bool) { r.establishedLive = live }

// Render renders the model. The ruleset shares unchanged parts with the ruleset that was rendered before.
func (r *Renderer) Render(model *policy.Model) *nft.Ruleset {
	p := &pass{podInterfaces: r.podInterfaces, establishedLive: r.establishedLive, model: model, out: nft.NewRuleset(), before: r.memory, memory: newMemory()}
	p.base()
	for _, f := range families {
		p.family(f)
	}
	r.memory = p.memory
	return p.out
}

type family struct {
	nft.Family
	suffix  string
	address nft.Type
	second  nft.Register // the one after an address in R0
	third   nft.Register
}

var families = []family{
	{nft.IPv4, "4", nft.TypeAddress4, nft.R1, nft.R2},
	{nft.IPv6, "6", nft.TypeAddress6, nft.R4, nft.R5},
}

func (f family) of(addr netip.Addr) bool { return addr.Is4() == (f.Family == nft.IPv4) }

// side is one of the two directions a policy speaks about.
type side struct {
	name        string
	priority    int32
	subject     nft.Direction // the tuple whose source is the selected pod
	peer        nft.Direction
	isolationOf func(*policy.Endpoint) policy.Isolation
}

var sides = []side{
	{"egress", 0, nft.Original, nft.Reply, func(e *policy.Endpoint) policy.Isolation { return e.Egress }},
	{"ingress", 1, nft.Reply, nft.Original, func(e *policy.Endpoint) policy.Isolation { return e.Ingress }},
}

// pass is one rendering.
type pass struct {
	podInterfaces   string
	establishedLive bool
	model           *policy.Model
	out             *nft.Ruleset
	before          memory
	memory
}

// recall returns the earlier result for this part, or makes it.
func recall[K comparable, V any](before, now map[K]V, key K, make func() V) V {
	if made, is := now[key]; is {
		return made
	}
	made, is := before[key]
	if !is {
		made = make()
	}
	now[key] = made
	return made
}

func rule(comment string, exprs ...[]nft.Expr) nft.Rule {
	return nft.Rule{Exprs: slices.Concat(exprs...), Comment: comment}
}

func e(exprs ...nft.Expr) []nft.Expr { return exprs }

// base writes the parts that do not depend on the model.
func (p *pass) base() {
	for i, side := range sides {
		chain := &nft.Chain{Hook: &nft.Hook{Number: unix.NF_INET_FORWARD, Priority: side.priority}}
		if i == 0 {
			chain.Rules = append(chain.Rules, rule("", e(nft.CtState(nft.R0)),
				nft.AnyBit(nft.R0, nft.StateInvalid|nft.StateUntracked), e(nft.Do(nft.Jump("stateless")))))
			if p.podInterfaces != "" {
				name := []byte(p.podInterfaces)
				chain.Rules = append(chain.Rules,
					rule("", e(nft.InputInterface(nft.R0), nft.Equal(nft.R0, name), nft.Do(nft.Jump("from_pods")))),
					rule("", e(nft.OutputInterface(nft.R0), nft.Equal(nft.R0, name), nft.Do(nft.Jump("to_pods")))))
			}
		}
		if p.establishedLive {
			// The kernel confirms a connection when its first packet has passed. The state "established" would need a reply,
			// which a DDS writer's flow of samples never gets.
			chain.Rules = append(chain.Rules, rule("established", e(nft.CtStatus(nft.R0)),
				nft.AnyBit(nft.R0, nft.StatusConfirmed), e(nft.Do(nft.Accept))))
		}
		for _, f := range families {
			chain.Rules = append(chain.Rules, rule("", e(nft.CtSource(f.Family, side.subject, nft.R0),
				nft.In(localSet+f.suffix, nft.R0), nft.Do(nft.Goto(side.name+f.suffix)))))
		}
		p.out.Chains[side.name] = chain
	}
	stateless, from, to := &nft.Chain{}, &nft.Chain{}, &nft.Chain{}
	for _, f := range families {
		// Without a connection the opener is unknown, so such packets never pass to or from an isolated pod.
		for _, load := range []nft.Expr{nft.PacketSource(f.Family, nft.R0), nft.PacketDestination(f.Family, nft.R0)} {
			stateless.Rules = append(stateless.Rules, rule("no connection", nft.IsFamily(f.Family),
				e(load, nft.In(isolatedSet+f.suffix, nft.R0), nft.Counter(), nft.Do(nft.Drop))))
		}
		from.Rules = append(from.Rules, rule("unknown pod", nft.IsFamily(f.Family),
			e(nft.PacketSource(f.Family, nft.R0), nft.NotIn(localSet+f.suffix, nft.R0), nft.Counter(), nft.Do(nft.Drop))))
		to.Rules = append(to.Rules, rule("unknown pod", nft.IsFamily(f.Family),
			e(nft.PacketDestination(f.Family, nft.R0), nft.NotIn(localSet+f.suffix, nft.R0), nft.Counter(), nft.Do(nft.Drop))))
	}
	p.out.Chains["stateless"] = stateless
	if p.podInterfaces != "" {
		p.out.Chains["from_pods"], p.out.Chains["to_pods"] = from, to
	}
}

func (p *pass) family(f family) {
	local, isolated, self := p.fixedSets(f)
	maps := make([]*nft.Set, len(sides))
	for i, side := range sides {
		name := side.name + f.suffix
		maps[i] = &nft.Set{Key: []nft.Type{f.address}, Map: true}
		p.out.Sets[name] = maps[i]
		p.out.Chains[name] = &nft.Chain{Rules: []nft.Rule{
			// An address that is missing here falls through to the drop, so that nothing leaks if a map and a set ever disagree.
			rule("", e(nft.CtSource(f.Family, side.subject, nft.R0), nft.Dispatch(name, nft.R0))),
			rule("itself", e(nft.CtSource(f.Family, nft.Original, nft.R0), nft.CtSource(f.Family, nft.Reply, f.second),
				nft.In(selfSet+f.suffix, nft.R0), nft.Do(nft.Accept))),
			rule("isolated", e(nft.Counter(), nft.Do(nft.Drop))),
		}}
	}
	for addr, endpoint := range p.model.Endpoints {
		if !f.of(addr) {
			continue
		}
		key := string(addr.AsSlice())
		local.Elements = append(local.Elements, nft.Element{Key: key})
		alone := false
		for i, side := range sides {
			isolation := side.isolationOf(endpoint)
			action := nft.Accept
			if isolation.Isolated {
				alone = true
				action = p.profile(f, side, endpoint, isolation.Rules)
			}
			maps[i].Elements = append(maps[i].Elements, nft.Element{Key: key, Action: action})
		}
		if alone {
			isolated.Elements = append(isolated.Elements, nft.Element{Key: key})
			self.Elements = append(self.Elements, nft.Element{Key: key + key})
		}
	}
	for _, set := range append(maps, local, isolated, self) {
		slices.SortFunc(set.Elements, func(a, b nft.Element) int { return strings.Compare(a.Key, b.Key) })
	}
}

func (p *pass) fixedSets(f family) (local, isolated, self *nft.Set) {
	local = &nft.Set{Key: []nft.Type{f.address}}
	isolated = &nft.Set{Key: []nft.Type{f.address}}
	self = &nft.Set{Key: []nft.Type{f.address, f.address}}
	p.out.Sets[localSet+f.suffix], p.out.Sets[isolatedSet+f.suffix], p.out.Sets[selfSet+f.suffix] = local, isolated, self
	return local, isolated, self
}

// profile sends to the chain of all pods that the same policies select.
func (p *pass) profile(f family, side side, endpoint *policy.Endpoint, rules []*policy.Rules) nft.Action {
	if len(rules) == 0 {
		return nft.Continue // to the drop
	}
	made := recall(p.before.profiles, p.profiles, profileKey{endpoint, side.name, f.Family}, func() profile {
		var content strings.Builder
		chain := &nft.Chain{}
		for _, r := range rules {
			content.WriteString(r.ID + " ")
			chain.Rules = append(chain.Rules, rule("", e(nft.Do(nft.Jump(policyName(f, side, r))))))
		}
		return profile{fmt.Sprintf("pods_%s%s_%s", side.name, f.suffix, digest(content.String())), chain}
	})
	if p.out.Chains[made.name] == nil {
		p.out.Chains[made.name] = made.chain
		for _, r := range rules {
			p.policy(f, side, r)
		}
	}
	return nft.Jump(made.name)
}

func policyName(f family, side side, rules *policy.Rules) string {
	return fmt.Sprintf("%s%s_%s", side.name, f.suffix, rules.ID)
}

// policy puts a policy's chains, and the sets that they name, into the ruleset.
func (p *pass) policy(f family, side side, rules *policy.Rules) {
	made := recall(p.before.policies, p.policies, partOf[*policy.Rules]{rules, f.Family}, func() *policyChains {
		return makePolicy(f, side, rules)
	})
	for name, chain := range made.chains {
		p.out.Chains[name] = chain
	}
	for name, id := range made.peers {
		if p.out.Sets[name] == nil {
			p.out.Sets[name] = p.peerSet(f, p.model.Peers[id])
		}
	}
	for name, port := range made.names {
		if p.out.Sets[name] == nil {
			p.out.Sets[name] = p.nameSet(f, port.Protocol, p.model.Names[port])
		}
	}
}

func makePolicy(f family, side side, rules *policy.Rules) *policyChains {
	chain := &nft.Chain{}
	made := &policyChains{name: policyName(f, side, rules), peers: map[string]policy.PeerID{}, names: map[string]policy.PortName{}}
	made.chains = map[string]*nft.Chain{made.name: chain}
	for i, r := range rules.Rules {
		comment := fmt.Sprintf("%s %s[%d]", rules.Policy, side.name, i)
		verdict := nft.Do(nft.Accept)
		if !r.AllPorts {
			verdict = nft.Do(nft.Jump(made.ports(f, r)))
		}
		if r.AllPeers {
			chain.Rules = append(chain.Rules, rule(comment, e(verdict)))
		}
		load := nft.CtSource(f.Family, side.peer, nft.R0)
		for _, id := range r.Peers {
			set := fmt.Sprintf("peers%s_%s", f.suffix, digest(string(id)))
			made.peers[set] = id
			chain.Rules = append(chain.Rules, rule(comment, e(load, nft.In(set, nft.R0), verdict)))
		}
		for _, block := range r.Blocks {
			if f.of(block.From) {
				chain.Rules = append(chain.Rules, rule(comment, e(load, nft.Between(nft.R0, block.From.AsSlice(), block.To.AsSlice()), verdict)))
			}
		}
	}
	return made
}

// ports makes the chain that accepts the ports of a rule. Rules with the same ports share it.
func (m *policyChains) ports(f family, r policy.Rule) string {
	chain := &nft.Chain{}
	for _, ports := range r.Ports {
		exprs := e(nft.CtProtocol(nft.R0), nft.Equal(nft.R0, []byte{byte(ports.Protocol)}))
		if ports.From == ports.To {
			exprs = append(exprs, nft.CtSourcePort(nft.Reply, nft.R0), nft.Equal(nft.R0, port(ports.From)))
		} else if ports.From > 0 || ports.To < 65535 {
			exprs = append(exprs, nft.CtSourcePort(nft.Reply, nft.R0), nft.Between(nft.R0, port(ports.From), port(ports.To)))
		}
		chain.Rules = append(chain.Rules, rule("", exprs, e(nft.Do(nft.Accept))))
	}
	for _, name := range r.Names {
		set := fmt.Sprintf("named%s_%s_%s", f.suffix, name.Protocol, name.Name)
		m.names[set] = name
		chain.Rules = append(chain.Rules, rule("", e(nft.CtSource(f.Family, nft.Reply, nft.R0), nft.CtProtocol(f.second),
			nft.CtSourcePort(nft.Reply, f.third), nft.In(set, nft.R0), nft.Do(nft.Accept))))
	}
	name := fmt.Sprintf("ports%s_%s", f.suffix, digest(fmt.Sprintf("%v %v", r.Ports, r.Names)))
	m.chains[name] = chain
	return name
}

func (p *pass) peerSet(f family, peers *policy.Addresses) *nft.Set {
	return recall(p.before.peers, p.peers, partOf[*policy.Addresses]{peers, f.Family}, func() *nft.Set {
		set := &nft.Set{Key: []nft.Type{f.address}}
		for _, addr := range peers.List {
			if f.of(addr) {
				set.Elements = append(set.Elements, nft.Element{Key: string(addr.AsSlice())})
			}
		}
		return set
	})
}

func (p *pass) nameSet(f family, protocol policy.Protocol, targets *policy.Targets) *nft.Set {
	return recall(p.before.names, p.names, partOf[*policy.Targets]{targets, f.Family}, func() *nft.Set {
		set := &nft.Set{Key: []nft.Type{f.address, nft.TypeProtocol, nft.TypePort}}
		for _, target := range targets.List {
			if f.of(target.Addr) {
				set.Elements = append(set.Elements, nft.Element{Key: string(target.Addr.AsSlice()) +
					string([]byte{byte(protocol), 0, 0, 0}) + string(port(target.Port)) + "\x00\x00"})
			}
		}
		return set // in order: targets are sorted by address and port
	})
}

func port(number uint16) []byte { return binary.BigEndian.AppendUint16(nil, number) }

func digest(text string) string {
	sum := sha256.Sum256([]byte(text))
	return hex.EncodeToString(sum[:6])
}
