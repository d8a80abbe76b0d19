package policy

import "net/netip"

// peerSet is the addresses that a selector of peers matches; uses counts the policies that have the selector.
type peerSet struct {
	*peerSelector
	uses   int
	set    *collection[netip.Addr]
	latest *Addresses
}

// nameSet is where a port name leads.
type nameSet struct {
	uses   int
	set    *collection[Target]
	latest *Targets
}

// use counts a policy among the users of its selectors and port names.
func (x *Index) use(policy *compiled) {
	for id, selector := range policy.peers {
		x.usePeer(id, selector)
	}
	for name := range policy.names {
		x.useName(name)
	}
}

// leave undoes use.
func (x *Index) leave(policy *compiled) {
	for id := range policy.peers {
		if x.peers[id].uses--; x.peers[id].uses == 0 {
			delete(x.peers, id)
		}
	}
	for name := range policy.names {
		if x.names[name].uses--; x.names[name].uses == 0 {
			delete(x.names, name)
		}
	}
}

func (x *Index) usePeer(id PeerID, selector *peerSelector) {
	if x.peers[id] == nil {
		peer := &peerSet{peerSelector: selector, set: newCollection(netip.Addr.Compare)}
		for addr, owner := range x.owners {
			peer.set.put(addr, x.matches(selector, owner.Pod))
		}
		x.peers[id] = peer
	}
	x.peers[id].uses++
}

func (x *Index) useName(name PortName) {
	if x.names[name] == nil {
		ports := &nameSet{set: newCollection(compareTargets)}
		for addr, owner := range x.owners {
			for _, port := range owner.Ports {
				if port.PortName == name {
					ports.set.put(Target{addr, port.Number}, true)
				}
			}
		}
		x.names[name] = ports
	}
	x.names[name].uses++
}
