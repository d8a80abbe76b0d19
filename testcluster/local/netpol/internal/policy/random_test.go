package policy_test

import (
	"fmt"
	"math/rand/v2"
	"net/netip"
	"slices"
	"strings"
	"testing"
	"time"

	corev1 "k8s.io/api/core/v1"
	networkingv1 "k8s.io/api/networking/v1"
	metav1 "k8s.io/apimachinery/pkg/apis/meta/v1"
	"k8s.io/apimachinery/pkg/labels"
	"k8s.io/apimachinery/pkg/types"
	"k8s.io/apimachinery/pkg/util/intstr"

	"understudy/testcluster/understudy-netpol/internal/policy"
)

// cluster is what the API holds; reading a policy from it is done again for every question, as plainly as possible.
type cluster struct {
	pods       map[policy.Key]*corev1.Pod
	namespaces map[string]labels.Set
	policies   map[policy.Key]*networkingv1.NetworkPolicy
}

// allows is the specification, written down a second time.
func (c *cluster) allows(from, to *corev1.Pod, proto corev1.Protocol, port int32) bool {
	if from.Name == to.Name && from.Namespace == to.Namespace {
		return true
	}
	leaves, arrives, outIsolated, inIsolated := false, false, false, false
	for _, p := range c.policies {
		in := slices.Contains(p.Spec.PolicyTypes, networkingv1.PolicyTypeIngress) || len(p.Spec.PolicyTypes) == 0
		out := slices.Contains(p.Spec.PolicyTypes, networkingv1.PolicyTypeEgress) || (len(p.Spec.PolicyTypes) == 0 && len(p.Spec.Egress) > 0)
		if out && c.selects(p, from) {
			outIsolated = true
			for _, r := range p.Spec.Egress {
				leaves = leaves || (c.isPeer(p, r.To, to) && isPort(r.Ports, to, proto, port))
			}
		}
		if in && c.selects(p, to) {
			inIsolated = true
			for _, r := range p.Spec.Ingress {
				arrives = arrives || (c.isPeer(p, r.From, from) && isPort(r.Ports, to, proto, port))
			}
		}
	}
	return (leaves || !outIsolated) && (arrives || !inIsolated)
}

func matches(selector *metav1.LabelSelector, set map[string]string) bool {
	s, err := metav1.LabelSelectorAsSelector(selector)
	if err != nil {
		panic(err)
	}
	return s.Matches(labels.Set(set))
}

func (c *cluster) selects(p *networkingv1.NetworkPolicy, pod *corev1.Pod) bool {
	return p.Namespace == pod.Namespace && matches(&p.Spec.PodSelector, pod.Labels)
}

func (c *cluster) isPeer(p *networkingv1.NetworkPolicy, peers []networkingv1.NetworkPolicyPeer, pod *corev1.Pod) bool {
	if len(peers) == 0 {
		return true
	}
	for _, peer := range peers {
		if peer.IPBlock != nil {
			in := func(cidr string) bool {
				return netip.MustParsePrefix(cidr).Contains(netip.MustParseAddr(pod.Status.PodIP))
			}
			if in(peer.IPBlock.CIDR) && !slices.ContainsFunc(peer.IPBlock.Except, in) {
				return true
			}
			continue
		}
		space := pod.Namespace == p.Namespace
		if peer.NamespaceSelector != nil {
			set, known := c.namespaces[pod.Namespace]
			space = known && matches(peer.NamespaceSelector, set)
		}
		if space && (peer.PodSelector == nil || matches(peer.PodSelector, pod.Labels)) {
			return true
		}
	}
	return false
}

func isPort(ports []networkingv1.NetworkPolicyPort, to *corev1.Pod, proto corev1.Protocol, number int32) bool {
	if len(ports) == 0 {
		return true
	}
	for _, p := range ports {
		if p.Protocol == nil && proto != corev1.ProtocolTCP || p.Protocol != nil && *p.Protocol != proto {
			continue
		}
		switch {
		case p.Port == nil:
			return true
		case p.Port.Type == intstr.String:
			for _, named := range to.Spec.Containers[0].Ports {
				if named.Name == p.Port.StrVal && named.Protocol == proto && named.ContainerPort == number {
					return true
				}
			}
		case p.EndPort != nil && p.Port.IntVal <= number && number <= *p.EndPort, p.Port.IntVal == number:
			return true
		}
	}
	return false
}

// generator draws small objects from few names, so that they meet often.
type generator struct{ *rand.Rand }

func (g generator) one(list ...string) string { return list[g.IntN(len(list))] }

func (g generator) labels() map[string]string {
	set := map[string]string{}
	for _, key := range []string{"app", "tier"} {
		if g.IntN(3) > 0 {
			set[key] = g.one("a", "b", "c")
		}
	}
	return set
}

func (g generator) selector() metav1.LabelSelector {
	s := metav1.LabelSelector{}
	if g.IntN(2) == 0 {
		s.MatchLabels = map[string]string{g.one("app", "tier"): g.one("a", "b", "c")}
	}
	if g.IntN(2) == 0 {
		r := metav1.LabelSelectorRequirement{Key: g.one("app", "tier"), Operator: metav1.LabelSelectorOperator(g.one("In", "NotIn", "Exists", "DoesNotExist"))}
		if r.Operator == "In" || r.Operator == "NotIn" {
			r.Values = []string{g.one("a", "b", "c"), g.one("a", "b", "c")}
		}
		s.MatchExpressions = append(s.MatchExpressions, r)
	}
	return s
}

func (g generator) peers() []networkingv1.NetworkPolicyPeer {
	var list []networkingv1.NetworkPolicyPeer
	for range g.IntN(3) {
		pods, spaces := g.selector(), g.selector()
		switch g.IntN(4) {
		case 0:
			list = append(list, networkingv1.NetworkPolicyPeer{PodSelector: &pods})
		case 1:
			list = append(list, networkingv1.NetworkPolicyPeer{NamespaceSelector: &spaces})
		case 2:
			list = append(list, networkingv1.NetworkPolicyPeer{PodSelector: &pods, NamespaceSelector: &spaces})
		case 3:
			block := &networkingv1.IPBlock{CIDR: g.one("10.0.0.0/8", "10.0.0.0/30", "10.0.0.4/31")}
			for range g.IntN(3) {
				block.Except = append(block.Except, g.one("10.0.0.0/29", "10.0.0.2/32", "10.0.0.5/32", "10.0.0.6/31"))
			}
			list = append(list, networkingv1.NetworkPolicyPeer{IPBlock: block})
		}
	}
	return list
}

func (g generator) ports() []networkingv1.NetworkPolicyPort {
	var list []networkingv1.NetworkPolicyPort
	for range g.IntN(3) {
		p := networkingv1.NetworkPolicyPort{}
		if g.IntN(2) == 0 {
			proto := corev1.Protocol(g.one("TCP", "UDP"))
			p.Protocol = &proto
		}
		switch g.IntN(4) {
		case 0:
			name := intstr.FromString(g.one("web", "command"))
			p.Port = &name
		case 1:
			number, end := intstr.FromInt32(1+g.Int32N(3)), 3+g.Int32N(3)
			p.Port, p.EndPort = &number, &end
		case 2:
			number := intstr.FromInt32(1 + g.Int32N(5))
			p.Port = &number
		}
		list = append(list, p)
	}
	return list
}

func (g generator) policy(key policy.Key) *networkingv1.NetworkPolicy {
	p := &networkingv1.NetworkPolicy{ObjectMeta: metav1.ObjectMeta{Namespace: key.Namespace, Name: key.Name}}
	p.Spec.PodSelector = g.selector()
	for range g.IntN(3) {
		p.Spec.Ingress = append(p.Spec.Ingress, networkingv1.NetworkPolicyIngressRule{From: g.peers(), Ports: g.ports()})
	}
	for range g.IntN(3) {
		p.Spec.Egress = append(p.Spec.Egress, networkingv1.NetworkPolicyEgressRule{To: g.peers(), Ports: g.ports()})
	}
	for _, kind := range []networkingv1.PolicyType{"Ingress", "Egress"} {
		if g.IntN(2) == 0 {
			p.Spec.PolicyTypes = append(p.Spec.PolicyTypes, kind)
		}
	}
	return p
}

func (g generator) pod(key policy.Key, address string) *corev1.Pod {
	p := &corev1.Pod{ObjectMeta: metav1.ObjectMeta{Namespace: key.Namespace, Name: key.Name, UID: types.UID(key.String()), Labels: g.labels()}}
	p.Spec.NodeName = g.one("here", "there")
	p.Spec.Containers = []corev1.Container{{}}
	for _, name := range []string{"web", "command"} {
		if g.IntN(2) == 0 {
			p.Spec.Containers[0].Ports = append(p.Spec.Containers[0].Ports,
				corev1.ContainerPort{Name: name, ContainerPort: 1 + g.Int32N(5), Protocol: corev1.Protocol(g.one("TCP", "UDP"))})
		}
	}
	p.Status.PodIP = address
	return p
}

// TestRandomChanges makes random changes and asks, after each, whether the index says what the specification says, and
// what an index says that was built from scratch.
func TestRandomChanges(t *testing.T) {
	seed := uint64(time.Now().UnixNano())
	t.Logf("seed %d", seed)
	g := generator{rand.New(rand.NewPCG(seed, 0))}
	keys := []policy.Key{{Namespace: "x", Name: "1"}, {Namespace: "x", Name: "2"}, {Namespace: "x", Name: "3"}, {Namespace: "y", Name: "1"}, {Namespace: "y", Name: "2"}, {Namespace: "z", Name: "1"}}
	c := &cluster{map[policy.Key]*corev1.Pod{}, map[string]labels.Set{}, map[policy.Key]*networkingv1.NetworkPolicy{}}
	here, there := policy.NewIndex("here"), policy.NewIndex("there")
	both := []*policy.Index{here, there}
	for step := range 3000 {
		i := g.IntN(len(keys))
		key := keys[i]
		gone := g.IntN(4) == 0
		var what string
		switch g.IntN(3) {
		case 0:
			what = fmt.Sprintf("pod %s, gone %t", key, gone)
			if delete(c.pods, key); !gone {
				c.pods[key] = g.pod(key, fmt.Sprint("10.0.0.", i+1))
			}
			for _, x := range both {
				if gone {
					x.DeletePod(key)
				} else {
					x.SetPod(policy.FromPod(c.pods[key]))
				}
			}
		case 1:
			what = fmt.Sprintf("namespace %s, gone %t", key.Namespace, gone)
			if delete(c.namespaces, key.Namespace); !gone {
				c.namespaces[key.Namespace] = g.labels()
			}
			for _, x := range both {
				if gone {
					x.DeleteNamespace(key.Namespace)
				} else {
					x.SetNamespace(key.Namespace, c.namespaces[key.Namespace])
				}
			}
		case 2:
			what = fmt.Sprintf("policy %s, gone %t", key, gone)
			if delete(c.policies, key); !gone {
				c.policies[key] = g.policy(key)
			}
			for _, x := range both {
				if gone {
					x.DeletePolicy(key)
				} else if _, problems := x.SetPolicy(c.policies[key]); len(problems) > 0 {
					t.Fatal(problems)
				}
			}
		}
		models := []*policy.Model{here.Model(), there.Model()}
		for n, node := range []string{"here", "there"} {
			if fresh := scratch(node, c); text(models[n]) != text(fresh) {
				t.Fatalf("step %d (%s): the index of %s has\n%s\nand from scratch it would have\n%s", step, what, node, text(models[n]), text(fresh))
			}
		}
		if step%10 == 0 {
			compare(t, c, models, step)
		}
	}
}

func scratch(node string, c *cluster) *policy.Model {
	x := policy.NewIndex(node)
	for _, p := range c.policies {
		x.SetPolicy(p)
	}
	for name, set := range c.namespaces {
		x.SetNamespace(name, set)
	}
	for _, pod := range c.pods {
		x.SetPod(policy.FromPod(pod))
	}
	return x.Model()
}

func text(m *policy.Model) string {
	out := ""
	for addr, e := range m.Endpoints {
		out += fmt.Sprintln(addr, e.Pod, e.Ingress.Isolated, e.Egress.Isolated)
		for _, r := range slices.Concat(e.Ingress.Rules, e.Egress.Rules) {
			out += fmt.Sprintln(addr, "rules", r.ID)
		}
	}
	for id, set := range m.Peers {
		out += fmt.Sprintln(id, set.List)
	}
	for name, set := range m.Names {
		out += fmt.Sprintln(name, set.List)
	}
	lines := strings.Split(out, "\n")
	slices.Sort(lines)
	return strings.Join(lines, "\n")
}

func compare(t *testing.T, c *cluster, models []*policy.Model, step int) {
	t.Helper()
	for _, from := range c.pods {
		for _, to := range c.pods {
			for name, proto := range map[corev1.Protocol]policy.Protocol{"TCP": policy.TCP, "UDP": policy.UDP} {
				for port := range int32(6) {
					f := policy.Flow{From: netip.MustParseAddr(from.Status.PodIP), To: netip.MustParseAddr(to.Status.PodIP), Protocol: proto, Port: uint16(port + 1)}
					got := true
					for _, m := range models {
						got = got && m.Leaves(f) && m.Arrives(f)
					}
					if want := c.allows(from, to, name, port+1); got != want {
						t.Fatalf("step %d: %+v: allowed is %t, want %t\npolicies: %+v", step, f, got, want, c.policies)
					}
				}
			}
		}
	}
}
