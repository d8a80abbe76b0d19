package policy

import (
	"maps"
	"net/netip"
	"slices"

	networkingv1 "k8s.io/api/networking/v1"
	"k8s.io/apimachinery/pkg/labels"
)

// Index keeps the state of the cluster so that one change costs little: a changed pod is compared with all selectors,
// a changed selector with all pods, and nothing else is computed again. It is not for concurrent use.
type Index struct {
	node       string
	pods       map[Key]*tracked
	sandboxes  map[string]Sandbox
	byPod      map[Key]map[string]bool // ids of a pod's sandboxes
	claims     map[netip.Addr]map[Key]bool
	owners     map[netip.Addr]*tracked
	namespaces map[string]labels.Set
	policies   map[Key]*compiled
	inSpace    map[string]map[Key]*compiled // policies by namespace
	peers      map[PeerID]*peerSet
	names      map[PortName]*nameSet
	endpoints  map[netip.Addr]*Endpoint
	keeps      bool // see KeepVanished
}

type tracked struct {
	*Pod
	addrs    []netip.Addr
	endpoint *Endpoint   // nil until computed; only for pods of this node
	vanished bool        // its object is gone
	frozen   bool        // its endpoint stays as it is
	kept     []*compiled // the policies of a frozen pod
}

// NewIndex returns an empty index for the node of that name.
func NewIndex(node string) *Index {
	return &Index{
		node: node, pods: map[Key]*tracked{}, sandboxes: map[string]Sandbox{}, byPod: map[Key]map[string]bool{},
		claims: map[netip.Addr]map[Key]bool{}, owners: map[netip.Addr]*tracked{}, namespaces: map[string]labels.Set{},
		policies: map[Key]*compiled{}, inSpace: map[string]map[Key]*compiled{}, peers: map[PeerID]*peerSet{},
		names: map[PortName]*nameSet{}, endpoints: map[netip.Addr]*Endpoint{},
	}
}

// SetPod takes a new or changed pod; false when nothing that matters has changed.
func (x *Index) SetPod(pod *Pod) bool {
	old := x.pods[pod.Key]
	if old != nil && old.same(pod) {
		return false
	}
	x.replacePod(pod.Key, x.next(old, pod))
	return true
}

// Pod returns a pod that is known, or nil.
func (x *Index) Pod(key Key) *Pod {
	if found := x.pods[key]; found != nil {
		return found.Pod
	}
	return nil
}

// DeletePod forgets a pod; false when it was not known.
func (x *Index) DeletePod(key Key) bool {
	old := x.pods[key]
	if old == nil {
		return false
	}
	x.replacePod(key, nil)
	if x.keeps {
		x.keep(old)
	}
	return true
}

// SetSandbox takes what the node's CNI has set up for a pod, by an id of the caller's choice.
func (x *Index) SetSandbox(id string, sandbox Sandbox) {
	x.DeleteSandbox(id)
	x.sandboxes[id] = sandbox
	if x.byPod[sandbox.Pod] == nil {
		x.byPod[sandbox.Pod] = map[string]bool{}
	}
	x.byPod[sandbox.Pod][id] = true
	x.again(sandbox.Pod)
}

// DeleteSandbox forgets one; false when it was not known.
func (x *Index) DeleteSandbox(id string) bool {
	sandbox, known := x.sandboxes[id]
	if !known {
		return false
	}
	delete(x.sandboxes, id)
	x.replacePod(vanishedKey(sandbox.Pod, sandbox.UID), nil)
	delete(x.byPod[sandbox.Pod], id)
	if len(x.byPod[sandbox.Pod]) == 0 {
		delete(x.byPod, sandbox.Pod)
	}
	x.again(sandbox.Pod)
	return true
}

func (x *Index) again(key Key) {
	if old := x.pods[key]; old != nil {
		x.replacePod(key, x.next(old, old.Pod))
	}
}

func (x *Index) replacePod(key Key, pod *tracked) {
	var affected []netip.Addr
	old := x.pods[key]
	if old != nil {
		affected = old.addrs
		for _, addr := range old.addrs {
			if delete(x.claims[addr], key); len(x.claims[addr]) == 0 {
				delete(x.claims, addr)
			}
		}
		delete(x.pods, key)
	}
	if pod != nil {
		x.pods[key] = pod
		pod.addrs = x.addressesOf(pod.Pod)
		for _, addr := range pod.addrs {
			if x.claims[addr] == nil {
				x.claims[addr] = map[Key]bool{}
			}
			x.claims[addr][key] = true
		}
		affected = slices.Concat(affected, pod.addrs)
	}
	for _, addr := range affected {
		x.refresh(addr)
	}
	if old != nil {
		for _, policy := range old.kept {
			x.leave(policy)
		}
	}
}

// addressesOf prefers the CNI's addresses to those that the kubelet has reported, which may belong to an old sandbox.
func (x *Index) addressesOf(pod *Pod) []netip.Addr {
	if pod.HostNetwork || pod.Ended {
		return nil
	}
	if pod.Node == x.node {
		var list []netip.Addr
		for id := range x.byPod[pod.Key] {
			if sandbox := x.sandboxes[id]; sandbox.UID == "" || sandbox.UID == pod.UID {
				list = append(list, sandbox.Addrs...)
			}
		}
		if len(list) > 0 {
			return list
		}
	}
	return pod.Reported
}

// refresh determines the owner of this address, and puts the address into, or takes it out of, all sets.
func (x *Index) refresh(addr netip.Addr) {
	owner := x.owner(addr)
	previous := x.owners[addr]
	if owner == nil {
		delete(x.owners, addr)
	} else {
		x.owners[addr] = owner
	}
	for _, peer := range x.peers {
		peer.set.put(addr, owner != nil && x.matches(peer.peerSelector, owner.Pod))
	}
	for name, ports := range x.names {
		for _, pod := range []*tracked{previous, owner} {
			if pod == nil {
				continue
			}
			for _, port := range pod.Ports {
				if port.PortName == name {
					ports.set.put(Target{addr, port.Number}, pod == owner)
				}
			}
		}
	}
	if owner != nil && owner.Node == x.node {
		x.endpoints[addr] = x.endpoint(owner)
	} else {
		delete(x.endpoints, addr)
	}
}

// owner decides between pods that claim the same address, which happens for a moment when an address is reused. A pod with a
// known sandbox certainly has it; otherwise the younger pod wins.
func (x *Index) owner(addr netip.Addr) *tracked {
	var best *tracked
	for key := range x.claims[addr] {
		pod := x.pods[key]
		if best == nil || x.stronger(pod, best, addr) {
			best = pod
		}
	}
	return best
}

func (x *Index) stronger(a, b *tracked, addr netip.Addr) bool {
	sinceA, sinceB := x.sandboxSince(a, addr), x.sandboxSince(b, addr)
	switch {
	case sinceA != sinceB:
		return sinceA > sinceB
	case !a.Created.Equal(b.Created):
		return a.Created.After(b.Created)
	}
	return a.UID > b.UID // any order will do, as long as it is always the same
}

func (x *Index) sandboxSince(pod *tracked, addr netip.Addr) int64 {
	latest := int64(0)
	for id := range x.byPod[pod.Key] {
		if sandbox := x.sandboxes[id]; slices.Contains(sandbox.Addrs, addr) {
			latest = max(latest, sandbox.Created.UnixNano())
		}
	}
	return latest
}

func (x *Index) matches(selector *peerSelector, pod *Pod) bool {
	if selector.namespaces == nil {
		return pod.Namespace == selector.namespace && selector.pods.Matches(pod.Labels)
	}
	space, known := x.namespaces[pod.Namespace]
	return known && selector.namespaces.Matches(space) && selector.pods.Matches(pod.Labels)
}

// SetNamespace takes a new or changed namespace; false when nothing that matters has changed.
func (x *Index) SetNamespace(name string, set labels.Set) bool {
	if old, known := x.namespaces[name]; known && labels.Equals(old, set) {
		return false
	}
	x.namespaces[name] = set
	x.rematchNamespace(name)
	return true
}

// DeleteNamespace forgets a namespace; false when it was not known.
func (x *Index) DeleteNamespace(name string) bool {
	if _, known := x.namespaces[name]; !known {
		return false
	}
	delete(x.namespaces, name)
	x.rematchNamespace(name)
	return true
}

func (x *Index) rematchNamespace(name string) {
	for addr, owner := range x.owners {
		if owner.Namespace != name {
			continue
		}
		for _, peer := range x.peers {
			peer.set.put(addr, x.matches(peer.peerSelector, owner.Pod))
		}
	}
}

// SetPolicy takes a new or changed policy; false when nothing that matters has changed. The errors name the
// parts of the policy that cannot be understood.
func (x *Index) SetPolicy(object *networkingv1.NetworkPolicy) (bool, []error) {
	policy, problems := compile(object)
	if old := x.policies[policy.key]; old != nil && old.fingerprint == policy.fingerprint {
		return false, problems
	}
	x.replacePolicy(policy.key, policy)
	return true, problems
}

// DeletePolicy forgets a policy; false when it was not known.
func (x *Index) DeletePolicy(key Key) bool {
	if x.policies[key] == nil {
		return false
	}
	x.replacePolicy(key, nil)
	return true
}

func (x *Index) replacePolicy(key Key, policy *compiled) {
	old := x.policies[key]
	if policy != nil {
		x.policies[key] = policy
		if x.inSpace[key.Namespace] == nil {
			x.inSpace[key.Namespace] = map[Key]*compiled{}
		}
		x.inSpace[key.Namespace][key] = policy
		x.use(policy)
	} else {
		delete(x.policies, key)
		delete(x.inSpace[key.Namespace], key)
	}
	if old != nil { // after the new one's, so that what both use is kept
		x.leave(old)
	}
	for addr, endpoint := range x.endpoints {
		owner := x.owners[addr]
		if owner.Namespace != key.Namespace || owner.frozen {
			continue
		}
		if (old != nil && old.selects.Matches(owner.Labels)) || (policy != nil && policy.selects.Matches(owner.Labels)) {
			if owner.endpoint == endpoint {
				owner.endpoint = nil // not yet computed again for another address of the same pod
			}
			x.endpoints[addr] = x.endpoint(owner)
		}
	}
}

func (x *Index) endpoint(pod *tracked) *Endpoint {
	if pod.endpoint != nil {
		return pod.endpoint
	}
	endpoint := &Endpoint{Pod: pod.Key}
	for _, policy := range x.policiesOf(pod) {
		endpoint.Ingress.add(policy.ingress)
		endpoint.Egress.add(policy.egress)
	}
	pod.endpoint = endpoint
	return endpoint
}

// policiesOf returns the policies that select a pod, or those that a frozen one keeps.
func (x *Index) policiesOf(pod *tracked) []*compiled {
	if pod.frozen {
		return pod.kept
	}
	var policies []*compiled
	for _, policy := range x.inSpace[pod.Namespace] {
		if policy.selects.Matches(pod.Labels) {
			policies = append(policies, policy)
		}
	}
	slices.SortFunc(policies, func(a, b *compiled) int { return compareKeys(a.key, b.key) })
	return policies
}

func (i *Isolation) add(rules *Rules) {
	if rules == nil {
		return
	}
	i.Isolated = true
	if len(rules.Rules) > 0 {
		i.Rules = append(i.Rules, rules)
	}
}

// Model returns what the node has to enforce now.
func (x *Index) Model() *Model {
	m := &Model{
		Endpoints: maps.Clone(x.endpoints),
		Peers:     make(map[PeerID]*Addresses, len(x.peers)),
		Names:     make(map[PortName]*Targets, len(x.names)),
	}
	for id, peer := range x.peers {
		if list, other := peer.set.sorted(); other || peer.latest == nil {
			peer.latest = &Addresses{list}
		}
		m.Peers[id] = peer.latest
	}
	for name, ports := range x.names {
		if list, other := ports.set.sorted(); other || ports.latest == nil {
			ports.latest = &Targets{list}
		}
		m.Names[name] = ports.latest
	}
	return m
}
