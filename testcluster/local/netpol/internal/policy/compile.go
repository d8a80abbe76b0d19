package policy

import (
	"crypto/sha256"
	"encoding/hex"
	"fmt"
	"net/netip"
	"strings"

	networkingv1 "k8s.io/api/networking/v1"
	metav1 "k8s.io/apimachinery/pkg/apis/meta/v1"
	"k8s.io/apimachinery/pkg/labels"
	"k8s.io/apimachinery/pkg/util/intstr"
)

// Rules is what one policy allows in one direction. It never changes: an edited policy gets new ones with another ID.
type Rules struct {
	Policy Key
	// ID is different for different content, and the same for the same.
	ID    string
	Rules []Rule
}

// Rule allows what matches one of the peers and one of the ports.
type Rule struct {
	AllPeers bool
	Peers    []PeerID
	Blocks   []Block

	AllPorts bool
	Ports    []Ports
	Names    []PortName
}

// PeerID names a set of pods by the selectors that make it.
type PeerID string

// Block is a range of addresses, both ends included.
type Block struct{ From, To netip.Addr }

// Contains reports whether the address lies in the block.
func (b Block) Contains(addr netip.Addr) bool {
	return b.From.BitLen() == addr.BitLen() && b.From.Compare(addr) <= 0 && addr.Compare(b.To) <= 0
}

// Ports is a range of ports of one protocol, both ends included; 0 to 65535 is the whole protocol.
type Ports struct {
	Protocol Protocol
	From, To uint16
}

type compiled struct {
	key             Key
	selects         labels.Selector
	ingress, egress *Rules // nil if the policy does not restrict the direction
	peers           map[PeerID]*peerSelector
	names           map[PortName]bool
	fingerprint     string
}

type peerSelector struct {
	namespace  string          // the only one, or
	namespaces labels.Selector // those with these labels
	pods       labels.Selector
}

// compile never fails: the API server has validated the policy. A part that is wrong nevertheless allows nothing, and the
// returned list names it.
func compile(object *networkingv1.NetworkPolicy) (*compiled, []error) {
	c := &compiled{
		key:   Key{object.Namespace, object.Name},
		peers: map[PeerID]*peerSelector{},
		names: map[PortName]bool{},
	}
	var problems []error
	problem := func(field string, err error) {
		problems = append(problems, fmt.Errorf("NetworkPolicy %s: %s: %w; it allows nothing", c.key, field, err))
	}
	selects, err := metav1.LabelSelectorAsSelector(&object.Spec.PodSelector)
	if err != nil {
		problem("spec.podSelector", err)
		selects = labels.Nothing()
	}
	c.selects = selects
	ingress, egress := directions(object.Spec)
	if ingress {
		c.ingress = &Rules{Policy: c.key}
		for i, rule := range object.Spec.Ingress {
			c.add(c.ingress, fmt.Sprintf("spec.ingress[%d]", i), "from", rule.From, rule.Ports, problem)
		}
		c.ingress.seal("ingress")
	}
	if egress {
		c.egress = &Rules{Policy: c.key}
		for i, rule := range object.Spec.Egress {
			c.add(c.egress, fmt.Sprintf("spec.egress[%d]", i), "to", rule.To, rule.Ports, problem)
		}
		c.egress.seal("egress")
	}
	c.fingerprint = fmt.Sprintf("%s|%s|%s", c.selects, c.ingress.id(), c.egress.id())
	return c, problems
}

// directions applies the API's default: ingress always, egress when there are egress rules.
func directions(spec networkingv1.NetworkPolicySpec) (ingress, egress bool) {
	if len(spec.PolicyTypes) == 0 {
		return true, len(spec.Egress) > 0
	}
	for _, kind := range spec.PolicyTypes {
		ingress = ingress || kind == networkingv1.PolicyTypeIngress
		egress = egress || kind == networkingv1.PolicyTypeEgress
	}
	return ingress, egress
}

func (c *compiled) add(rules *Rules, field, peerField string, peers []networkingv1.NetworkPolicyPeer, ports []networkingv1.NetworkPolicyPort, problem func(string, error)) {
	rule := Rule{AllPeers: len(peers) == 0, AllPorts: len(ports) == 0}
	for i, peer := range peers {
		at := fmt.Sprintf("%s.%s[%d]", field, peerField, i)
		if peer.IPBlock != nil {
			blocks, err := subtract(peer.IPBlock)
			if err != nil {
				problem(at+".ipBlock", err)
				continue
			}
			rule.Blocks = append(rule.Blocks, blocks...)
			continue
		}
		selector, err := c.peer(peer)
		if err != nil {
			problem(at, err)
			continue
		}
		id := selector.id()
		c.peers[id] = selector
		rule.Peers = append(rule.Peers, id)
	}
	for i, port := range ports {
		if err := c.port(&rule, port); err != nil {
			problem(fmt.Sprintf("%s.ports[%d]", field, i), err)
		}
	}
	rules.Rules = append(rules.Rules, rule)
}

func (c *compiled) peer(peer networkingv1.NetworkPolicyPeer) (*peerSelector, error) {
	if peer.PodSelector == nil && peer.NamespaceSelector == nil {
		return nil, fmt.Errorf("no selector and no ipBlock: give one of them")
	}
	selector := &peerSelector{pods: labels.Everything()}
	var err error
	if peer.PodSelector != nil {
		if selector.pods, err = metav1.LabelSelectorAsSelector(peer.PodSelector); err != nil {
			return nil, err
		}
	}
	if peer.NamespaceSelector == nil {
		selector.namespace = c.key.Namespace
		return selector, nil
	}
	selector.namespaces, err = metav1.LabelSelectorAsSelector(peer.NamespaceSelector)
	return selector, err
}

func (c *compiled) port(rule *Rule, port networkingv1.NetworkPolicyPort) error {
	proto, known := protocol(port.Protocol)
	if !known {
		return fmt.Errorf("protocol %q is none of TCP, UDP, SCTP", *port.Protocol)
	}
	switch {
	case port.Port == nil:
		rule.Ports = append(rule.Ports, Ports{proto, 0, 65535})
	case port.Port.Type == intstr.String:
		if port.EndPort != nil {
			return fmt.Errorf("endPort %d with the named port %q: it needs a number", *port.EndPort, port.Port.StrVal)
		}
		name := PortName{proto, port.Port.StrVal}
		c.names[name] = true
		rule.Names = append(rule.Names, name)
	default:
		from, to := port.Port.IntVal, port.Port.IntVal
		if port.EndPort != nil {
			to = *port.EndPort
		}
		if from < 1 || to < from || to > 65535 {
			return fmt.Errorf("ports %d to %d are no range within 1 to 65535", from, to)
		}
		rule.Ports = append(rule.Ports, Ports{proto, uint16(from), uint16(to)})
	}
	return nil
}

func (s *peerSelector) id() PeerID {
	if s.namespaces == nil {
		return PeerID(fmt.Sprintf("pods {%s} in namespace %s", s.pods, s.namespace))
	}
	return PeerID(fmt.Sprintf("pods {%s} in namespaces {%s}", s.pods, s.namespaces))
}

func (r *Rules) id() string {
	if r == nil {
		return ""
	}
	return r.ID
}

func (r *Rules) seal(direction string) {
	content := fmt.Sprintf("%s %s %+v", direction, r.Policy, r.Rules)
	sum := sha256.Sum256([]byte(content))
	name := r.Policy.String()
	r.ID = fmt.Sprintf("%s-%s", name[:min(len(name), 100)], hex.EncodeToString(sum[:5]))
}

// subtract returns cidr without the excepted blocks, as ranges in order.
func subtract(block *networkingv1.IPBlock) ([]Block, error) {
	whole, err := parseBlock(block.CIDR)
	if err != nil {
		return nil, fmt.Errorf("cidr: %w", err)
	}
	left := []Block{whole}
	for i, text := range block.Except {
		except, err := parseBlock(text)
		if err != nil {
			return nil, fmt.Errorf("except[%d]: %w", i, err)
		}
		var rest []Block
		for _, piece := range left {
			rest = append(rest, piece.without(except)...)
		}
		left = rest
	}
	return left, nil
}

func (b Block) without(hole Block) []Block {
	if hole.From.BitLen() != b.From.BitLen() || hole.To.Less(b.From) || b.To.Less(hole.From) {
		return []Block{b}
	}
	var rest []Block
	if b.From.Less(hole.From) {
		rest = append(rest, Block{b.From, hole.From.Prev()})
	}
	if hole.To.Less(b.To) {
		rest = append(rest, Block{hole.To.Next(), b.To})
	}
	return rest
}

func parseBlock(text string) (Block, error) {
	prefix, err := netip.ParsePrefix(strings.TrimSpace(text))
	if err != nil {
		return Block{}, err
	}
	prefix = netip.PrefixFrom(prefix.Addr().Unmap(), prefix.Bits()).Masked()
	last := prefix.Addr().AsSlice()
	for bit := prefix.Bits(); bit < len(last)*8; bit++ {
		last[bit/8] |= 0x80 >> (bit % 8)
	}
	to, _ := netip.AddrFromSlice(last)
	return Block{prefix.Addr(), to}, nil
}
