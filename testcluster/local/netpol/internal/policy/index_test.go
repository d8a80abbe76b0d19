package policy_test

import (
	"net/netip"
	"testing"
	"time"

	corev1 "k8s.io/api/core/v1"
	networkingv1 "k8s.io/api/networking/v1"
	metav1 "k8s.io/apimachinery/pkg/apis/meta/v1"
	"k8s.io/apimachinery/pkg/types"
	"k8s.io/apimachinery/pkg/util/intstr"

	"understudy/testcluster/understudy-netpol/internal/policy"
)

func pod(name, address string, change func(*corev1.Pod)) *policy.Pod {
	object := &corev1.Pod{
		ObjectMeta: metav1.ObjectMeta{Namespace: "x", Name: name, UID: types.UID(name), Labels: map[string]string{"name": name}},
		Spec:       corev1.PodSpec{NodeName: "here"},
		Status:     corev1.PodStatus{Phase: corev1.PodRunning, PodIP: address, PodIPs: []corev1.PodIP{{IP: address}}},
	}
	if change != nil {
		change(object)
	}
	return policy.FromPod(object)
}

func owner(x *policy.Index, address string) string {
	endpoint := x.Model().Endpoints[netip.MustParseAddr(address)]
	if endpoint == nil {
		return ""
	}
	return endpoint.Pod.Name
}

func expectOwner(t *testing.T, x *policy.Index, when, address, want string) {
	t.Helper()
	if got := owner(x, address); got != want {
		t.Errorf("%s: %s belongs to %q, want %q", when, address, got, want)
	}
}

func TestAnEndedPodHasNoAddress(t *testing.T) {
	for _, phase := range []corev1.PodPhase{corev1.PodSucceeded, corev1.PodFailed} {
		x := policy.NewIndex("here")
		x.SetPod(pod("a", "10.0.0.1", func(p *corev1.Pod) { p.Status.Phase = phase }))
		expectOwner(t, x, string(phase), "10.0.0.1", "")
	}
}

func TestAPodBeingDeletedKeepsItsAddress(t *testing.T) {
	x := policy.NewIndex("here")
	now := metav1.Now()
	x.SetPod(pod("a", "10.0.0.1", func(p *corev1.Pod) { p.DeletionTimestamp = &now }))
	expectOwner(t, x, "terminating", "10.0.0.1", "a")
	x.DeletePod(policy.Key{Namespace: "x", Name: "a"})
	expectOwner(t, x, "gone", "10.0.0.1", "")
}

func TestAPodOnTheHostsNetworkHasNoAddress(t *testing.T) {
	x := policy.NewIndex("here")
	x.SetPod(pod("a", "10.0.0.1", func(p *corev1.Pod) { p.Spec.HostNetwork = true }))
	expectOwner(t, x, "host network", "10.0.0.1", "")
}

func TestTheYoungerPodOwnsAReusedAddress(t *testing.T) {
	old := pod("old", "10.0.0.1", func(p *corev1.Pod) { p.CreationTimestamp = metav1.Unix(1, 0) })
	young := pod("young", "10.0.0.1", func(p *corev1.Pod) { p.CreationTimestamp = metav1.Unix(2, 0) })
	for _, order := range [][2]*policy.Pod{{old, young}, {young, old}} {
		x := policy.NewIndex("here")
		x.SetPod(order[0])
		x.SetPod(order[1])
		expectOwner(t, x, "both there", "10.0.0.1", "young")
		x.DeletePod(young.Key)
		expectOwner(t, x, "younger gone", "10.0.0.1", "old")
	}
}

func TestTheNetworkIsBelievedOverTheStatus(t *testing.T) {
	x := policy.NewIndex("here")
	sandbox := func(name, uid, address string, second int64) policy.Sandbox {
		return policy.Sandbox{Pod: policy.Key{Namespace: "x", Name: name}, UID: uid, Addrs: []netip.Addr{netip.MustParseAddr(address)}, Created: time.Unix(second, 0)}
	}
	x.SetSandbox("1", sandbox("a", "a", "10.0.0.1", 1)) // before the pod is known
	expectOwner(t, x, "without a pod", "10.0.0.1", "")
	x.SetPod(pod("a", "", nil))
	expectOwner(t, x, "before the status", "10.0.0.1", "a")
	x.SetPod(pod("a", "10.0.0.9", nil))
	expectOwner(t, x, "against the status", "10.0.0.1", "a")
	expectOwner(t, x, "against the status", "10.0.0.9", "")
	x.SetSandbox("2", sandbox("a", "another-a", "10.0.0.2", 2))
	expectOwner(t, x, "of an earlier pod of that name", "10.0.0.2", "")
	x.SetPod(pod("b", "", nil))
	x.SetSandbox("3", sandbox("b", "b", "10.0.0.1", 3))
	expectOwner(t, x, "a later network with the same address", "10.0.0.1", "b")
	x.DeleteSandbox("3")
	expectOwner(t, x, "later network gone", "10.0.0.1", "a")
	x.DeleteSandbox("1")
	expectOwner(t, x, "all networks gone", "10.0.0.9", "a")
}

func TestUnimportantChangesAreNone(t *testing.T) {
	x := policy.NewIndex("here")
	x.SetPod(pod("a", "10.0.0.1", nil))
	if x.SetPod(pod("a", "10.0.0.1", func(p *corev1.Pod) {
		p.ResourceVersion = "2"
		p.Annotations = map[string]string{"a": "b"}
		p.Status.Message = "m"
	})) {
		t.Error("a status update counts as a change")
	}
	if !x.SetPod(pod("a", "10.0.0.1", func(p *corev1.Pod) { p.Labels["b"] = "c" })) {
		t.Error("a new label does not count as a change")
	}
	p := &networkingv1.NetworkPolicy{ObjectMeta: metav1.ObjectMeta{Namespace: "x", Name: "p"}}
	x.SetPolicy(p)
	again := p.DeepCopy()
	again.Annotations = map[string]string{"epoch": "2"}
	if changed, _ := x.SetPolicy(again); changed {
		t.Error("an annotation counts as a change of a policy")
	}
}

func TestAFrozenPodKeepsItsPolicyWhateverChanges(t *testing.T) {
	x := policy.NewIndex("here")
	x.SetPod(pod("a", "", nil))
	key := policy.Key{Namespace: "x", Name: "a"}
	if x.Freeze(key) {
		t.Error("a pod without a network is frozen")
	}
	x.SetPod(pod("a", "10.0.0.1", nil))
	x.SetPod(pod("b", "10.0.0.2", nil))
	p := &networkingv1.NetworkPolicy{ObjectMeta: metav1.ObjectMeta{Namespace: "x", Name: "p"}}
	p.Spec.PodSelector.MatchLabels = map[string]string{"name": "a"}
	p.Spec.Ingress = []networkingv1.NetworkPolicyIngressRule{{From: []networkingv1.NetworkPolicyPeer{
		{PodSelector: &metav1.LabelSelector{MatchLabels: map[string]string{"name": "b"}}}}}}
	x.SetPolicy(p)
	x.SetPod(pod("c", "10.0.0.3", nil))
	expect := func(when string, b, c bool) {
		t.Helper()
		for from, want := range map[string]bool{"10.0.0.2": b, "10.0.0.3": c} {
			f := policy.Flow{From: netip.MustParseAddr(from), To: netip.MustParseAddr("10.0.0.1"), Protocol: policy.TCP, Port: 80}
			if got := x.Model().Arrives(f); got != want {
				t.Errorf("%s: %s is allowed: %t, want %t", when, from, got, want)
			}
		}
	}
	expect("before", true, false)
	if !x.Freeze(key) {
		t.Error("a pod with a network is not frozen")
	}
	x.DeletePolicy(policy.Key{Namespace: "x", Name: "p"})
	expect("without its policy", true, false)
	x.SetPod(pod("a", "10.0.0.1", func(p *corev1.Pod) { p.Labels["name"] = "z" }))
	expect("with other labels", true, false)
	x.Thaw(key)
	expect("thawed", true, true)
	if left := x.Model().Peers; len(left) > 0 {
		t.Errorf("nobody uses these sets: %v", left)
	}
	x.SetPolicy(p)
	x.SetPod(pod("a", "10.0.0.1", nil))
	x.Freeze(key)
	x.DeletePolicy(policy.Key{Namespace: "x", Name: "p"})
	x.DeletePod(key)
	if left := x.Model().Peers; len(left) > 0 {
		t.Errorf("nobody uses these sets after the frozen pod is gone: %v", left)
	}
	x.SetPod(pod("a", "10.0.0.1", nil))
	expect("another pod of that name", true, true)
}

func TestPortsOfSidecarsCountAndThoseOfOtherInitContainersDoNot(t *testing.T) {
	always := corev1.ContainerRestartPolicyAlways
	p := pod("a", "10.0.0.1", func(p *corev1.Pod) {
		port := func(name string) []corev1.ContainerPort {
			return []corev1.ContainerPort{{Name: name, ContainerPort: 80}}
		}
		p.Spec.InitContainers = []corev1.Container{{Ports: port("early")}, {RestartPolicy: &always, Ports: port("side")}}
		p.Spec.Containers = []corev1.Container{{Ports: port("main")}}
	})
	names := ""
	for _, port := range p.Ports {
		names += port.Name + " "
	}
	if names != "main side " {
		t.Errorf("named ports are %q", names)
	}
}

// TestWhatCannotBeUnderstoodAllowsNothing gives policies that the API server would have refused.
func TestWhatCannotBeUnderstoodAllowsNothing(t *testing.T) {
	bad := metav1.LabelSelector{MatchExpressions: []metav1.LabelSelectorRequirement{{Key: "a", Operator: "Like"}}}
	name, number := intstr.FromString("web"), intstr.FromInt32(80)
	end, low := int32(90), int32(70)
	odd := corev1.Protocol("QUIC")
	peer := func(p networkingv1.NetworkPolicyPeer) []networkingv1.NetworkPolicyIngressRule {
		return []networkingv1.NetworkPolicyIngressRule{{From: []networkingv1.NetworkPolicyPeer{p}}}
	}
	port := func(p networkingv1.NetworkPolicyPort) []networkingv1.NetworkPolicyIngressRule {
		return []networkingv1.NetworkPolicyIngressRule{{Ports: []networkingv1.NetworkPolicyPort{p}}}
	}
	for what, rules := range map[string][]networkingv1.NetworkPolicyIngressRule{
		"operator":           peer(networkingv1.NetworkPolicyPeer{PodSelector: &bad}),
		"namespace operator": peer(networkingv1.NetworkPolicyPeer{NamespaceSelector: &bad}),
		"empty peer":         peer(networkingv1.NetworkPolicyPeer{}),
		"cidr":               peer(networkingv1.NetworkPolicyPeer{IPBlock: &networkingv1.IPBlock{CIDR: "10.0.0.0/40"}}),
		"except":             peer(networkingv1.NetworkPolicyPeer{IPBlock: &networkingv1.IPBlock{CIDR: "10.0.0.0/8", Except: []string{"ten"}}}),
		"protocol":           port(networkingv1.NetworkPolicyPort{Protocol: &odd}),
		"endPort and name":   port(networkingv1.NetworkPolicyPort{Port: &name, EndPort: &end}),
		"endPort below port": port(networkingv1.NetworkPolicyPort{Port: &number, EndPort: &low}),
	} {
		x := policy.NewIndex("here")
		x.SetNamespace("x", nil)
		x.SetPod(pod("a", "10.0.0.1", nil))
		x.SetPod(pod("b", "10.0.0.2", nil))
		p := &networkingv1.NetworkPolicy{ObjectMeta: metav1.ObjectMeta{Namespace: "x", Name: "p"}}
		p.Spec.Ingress = rules
		_, problems := x.SetPolicy(p)
		if len(problems) != 1 {
			t.Errorf("%s: %d problems named, want 1: %v", what, len(problems), problems)
		}
		f := policy.Flow{From: netip.MustParseAddr("10.0.0.1"), To: netip.MustParseAddr("10.0.0.2"), Protocol: policy.TCP, Port: 80}
		if x.Model().Arrives(f) {
			t.Errorf("%s: something is allowed", what)
		}
	}
}
