package ruleset_test

import (
	"fmt"
	"net/netip"
	"testing"

	networkingv1 "k8s.io/api/networking/v1"
	"k8s.io/apimachinery/pkg/labels"
	"sigs.k8s.io/yaml"

	"understudy/testcluster/understudy-netpol/internal/nft"
	"understudy/testcluster/understudy-netpol/internal/policy"
	"understudy/testcluster/understudy-netpol/internal/ruleset"
)

func policyOf(t testing.TB, name, spec string) *networkingv1.NetworkPolicy {
	t.Helper()
	object := &networkingv1.NetworkPolicy{}
	object.Namespace, object.Name = "fleet", name
	if err := yaml.UnmarshalStrict([]byte(spec), &object.Spec); err != nil {
		t.Fatal(err)
	}
	return object
}

func gate(t testing.TB, workload int, open string) *networkingv1.NetworkPolicy {
	return policyOf(t, fmt.Sprintf("w%d-gate", workload), fmt.Sprintf(`{podSelector: {matchLabels: {app: w%d, instance: %s}}, policyTypes: [Egress], egress: [{}]}`, workload, open))
}

// fleet is an index of workloads with two instances and a robot each, here of them on this node.
func fleet(t testing.TB, workloads, here int) *policy.Index {
	x := policy.NewIndex("here")
	x.SetNamespace("fleet", labels.Set{"kubernetes.io/metadata.name": "fleet"})
	for w := range workloads {
		node := "there"
		if w < here {
			node = "here"
		}
		for i, instance := range []string{"a", "b", "robot"} {
			app := fmt.Sprint("w", w)
			if instance == "robot" {
				app = "robot-of-" + app
			}
			x.SetPod(&policy.Pod{Key: policy.Key{Namespace: "fleet", Name: fmt.Sprintf("w%d-%s", w, instance)}, Node: node,
				Labels:   labels.Set{"app": app, "instance": instance},
				Reported: []netip.Addr{netip.AddrFrom4([4]byte{10, byte(i), byte(w / 250), byte(1 + w%250)})}})
		}
		others := fmt.Sprintf(`{namespaceSelector: {}, podSelector: {matchExpressions: [{key: app, operator: NotIn, values: [w%d]}]}}`, w)
		x.SetPolicy(policyOf(t, fmt.Sprintf("w%d-standby", w), fmt.Sprintf(`{podSelector: {matchLabels: {app: w%d}}, policyTypes: [Ingress, Egress], ingress: [{from: [%s]}],
			egress: [{to: [%s], ports: [{port: 1, endPort: 65535}, {protocol: UDP, port: 1, endPort: 7949}, {protocol: UDP, port: 8150, endPort: 65535}]}]}`, w, others, others)))
		x.SetPolicy(gate(t, w, "a"))
	}
	return x
}

func update(r *ruleset.Renderer, x *policy.Index, have *nft.Ruleset) (*nft.Ruleset, *nft.Batch) {
	want := r.Render(x.Model())
	return want, nft.Update(ruleset.Table, have, want)
}

func TestASwitchTouchesFourElementsAndNoRule(t *testing.T) {
	x, r := fleet(t, 20, 20), ruleset.NewRenderer("veth")
	have := r.Render(x.Model())
	x.SetPolicy(gate(t, 7, "b"))
	_, batch := update(r, x, have)
	if want := (nft.Changes{ElementsAdded: 2, ElementsRemoved: 2}); batch.Changes != want {
		t.Errorf("a switch is %+v, want %+v", batch.Changes, want)
	}
}

func TestClosingAndOpeningAGate(t *testing.T) {
	x, r := fleet(t, 20, 20), ruleset.NewRenderer("veth")
	have := r.Render(x.Model())
	x.SetPolicy(gate(t, 7, "nobody"))
	have, batch := update(r, x, have)
	// The chain of "standby and gate" is nobody's now, and with it the gate's own.
	if want := (nft.Changes{ElementsAdded: 1, ElementsRemoved: 1, ChainsRemoved: 2}); batch.Changes != want {
		t.Errorf("closing is %+v, want %+v", batch.Changes, want)
	}
	x.SetPolicy(gate(t, 7, "b"))
	_, batch = update(r, x, have)
	if want := (nft.Changes{ElementsAdded: 1, ElementsRemoved: 1, ChainsAdded: 2, Rules: 3}); batch.Changes != want {
		t.Errorf("opening is %+v, want %+v", batch.Changes, want)
	}
}

func TestAPodOfAnotherNodeIsAnElementOfPeers(t *testing.T) {
	x, r := fleet(t, 3, 2), ruleset.NewRenderer("veth")
	have := r.Render(x.Model())
	x.SetPod(&policy.Pod{Key: policy.Key{Namespace: "fleet", Name: "far"}, Node: "there", Reported: []netip.Addr{netip.MustParseAddr("10.9.9.9")}})
	_, batch := update(r, x, have)
	if want := (nft.Changes{ElementsAdded: 2}); batch.Changes != want {
		t.Errorf("a pod of another node is %+v, want %+v (one element for each workload of this node)", batch.Changes, want)
	}
}

func TestNothingChangesWithoutAChange(t *testing.T) {
	x, r := fleet(t, 20, 20), ruleset.NewRenderer("veth")
	have := r.Render(x.Model())
	if _, batch := update(r, x, have); !batch.Empty() {
		t.Errorf("without a change there are %+v", batch.Changes)
	}
	if batch := nft.Update(ruleset.Table, have, ruleset.NewRenderer("veth").Render(fleet(t, 20, 20).Model())); !batch.Empty() {
		t.Errorf("the same cluster seen again differs by %+v", batch.Changes)
	}
}

func TestNothingIsLeftWithoutPods(t *testing.T) {
	x, r := fleet(t, 20, 20), ruleset.NewRenderer("veth")
	have := r.Render(x.Model())
	for w := range 20 {
		for _, instance := range []string{"a", "b", "robot"} {
			x.DeletePod(policy.Key{Namespace: "fleet", Name: fmt.Sprintf("w%d-%s", w, instance)})
		}
	}
	have, _ = update(r, x, have)
	if batch := nft.Update(ruleset.Table, have, ruleset.NewRenderer("veth").Render(policy.NewIndex("here").Model())); !batch.Empty() {
		t.Errorf("left over: %+v", batch.Changes)
	}
}

func BenchmarkSwitch(b *testing.B) {
	for _, size := range []struct{ workloads, here int }{{20, 20}, {400, 40}} {
		b.Run(fmt.Sprintf("%d-pods-%d-here", size.workloads*3, size.here*3), func(b *testing.B) {
			x, r := fleet(b, size.workloads, size.here), ruleset.NewRenderer("veth")
			have := r.Render(x.Model())
			gates := []*networkingv1.NetworkPolicy{gate(b, 7, "b"), gate(b, 7, "a")}
			for i := 0; b.Loop(); i++ {
				x.SetPolicy(gates[i%2])
				have, _ = update(r, x, have)
			}
		})
	}
}

func BenchmarkPodComes(b *testing.B) {
	x, r := fleet(b, 400, 40), ruleset.NewRenderer("veth")
	have := r.Render(x.Model())
	pod := &policy.Pod{Key: policy.Key{Namespace: "fleet", Name: "far"}, Node: "there", Reported: []netip.Addr{netip.MustParseAddr("10.9.9.9")}}
	for i := 0; b.Loop(); i++ {
		if i%2 == 0 {
			x.SetPod(pod)
		} else {
			x.DeletePod(pod.Key)
		}
		have, _ = update(r, x, have)
	}
}
