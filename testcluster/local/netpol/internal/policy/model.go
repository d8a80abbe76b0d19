package policy

import "net/netip"

// Model is what one node enforces. Its parts are never changed: what differs from one model to the next is another
// pointer, so that unchanged parts are recognised without looking into them.
type Model struct {
	Endpoints map[netip.Addr]*Endpoint
	Peers     map[PeerID]*Addresses
	Names     map[PortName]*Targets
}

// Endpoint is an address of a pod of this node.
type Endpoint struct {
	Pod             Key
	Ingress, Egress Isolation
}

// Isolation of a pod in one direction. An isolated pod may do what any of the rules allows, and nothing else.
type Isolation struct {
	Isolated bool
	Rules    []*Rules // in the order of their policies' names, without policies that allow nothing
}

// Addresses is a sorted list.
type Addresses struct{ List []netip.Addr }

// Targets is the sorted list of where a port name leads.
type Targets struct{ List []Target }

// Target is a port at an address.
type Target struct {
	Addr netip.Addr
	Port uint16
}

// Flow is a connection, from the one who opened it to the one who really answers (after service translation).
type Flow struct {
	From, To netip.Addr
	Protocol Protocol // others than TCP, UDP and SCTP have no ports
	Port     uint16   // at the destination
}

// Leaves reports whether this node lets the flow out of its source. A source that is not on this node is not its concern.
func (m *Model) Leaves(f Flow) bool {
	endpoint := m.Endpoints[f.From]
	return endpoint == nil || f.From == f.To || m.allows(endpoint.Egress, f, f.To)
}

// Arrives reports whether this node lets the flow in to its destination.
func (m *Model) Arrives(f Flow) bool {
	endpoint := m.Endpoints[f.To]
	return endpoint == nil || f.From == f.To || m.allows(endpoint.Ingress, f, f.From)
}

func (m *Model) allows(isolation Isolation, f Flow, peer netip.Addr) bool {
	if !isolation.Isolated {
		return true
	}
	for _, rules := range isolation.Rules {
		for _, rule := range rules.Rules {
			if m.isPeer(rule, peer) && m.isPort(rule, f) {
				return true
			}
		}
	}
	return false
}

func (m *Model) isPeer(rule Rule, peer netip.Addr) bool {
	if rule.AllPeers {
		return true
	}
	for _, id := range rule.Peers {
		if set := m.Peers[id]; set != nil && set.Has(peer) {
			return true
		}
	}
	for _, block := range rule.Blocks {
		if block.Contains(peer) {
			return true
		}
	}
	return false
}

func (m *Model) isPort(rule Rule, f Flow) bool {
	if rule.AllPorts {
		return true
	}
	for _, ports := range rule.Ports {
		if ports.Protocol == f.Protocol && ports.From <= f.Port && f.Port <= ports.To {
			return true
		}
	}
	for _, name := range rule.Names {
		if name.Protocol != f.Protocol || m.Names[name] == nil {
			continue
		}
		for _, target := range m.Names[name].List {
			if target == (Target{f.To, f.Port}) {
				return true
			}
		}
	}
	return false
}
