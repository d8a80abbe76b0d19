package packettest

import (
	"encoding/json"
	"fmt"
	"maps"
	"net/netip"
	"os"
	"path/filepath"
	"slices"
	"strings"
	"testing"
	"time"

	corev1 "k8s.io/api/core/v1"
	networkingv1 "k8s.io/api/networking/v1"

	"understudy/testcluster/understudy-netpol/internal/enforcer"
)

// setModes gives a node its modes, and returns why it refuses them; empty when they are in force.
func (w *world) setModes(t *testing.T, on int, text string) string {
	t.Helper()
	path := w.nodes[on].modes
	must(t, os.WriteFile(path+".new", []byte(text), 0o600))
	must(t, os.Rename(path+".new", path))
	for end := time.Now().Add(10 * time.Second); time.Now().Before(end); time.Sleep(5 * time.Millisecond) {
		var applied enforcer.Applied
		data, err := os.ReadFile(path + ".applied")
		if err == nil && json.Unmarshal(data, &applied) == nil && applied.Text == text {
			return applied.Error
		}
	}
	t.Fatalf("node %d does not answer to the modes %s", on, text)
	return ""
}

func (w *world) inMode(t *testing.T, text string) {
	t.Helper()
	if refused := w.setModes(t, 0, text); refused != "" {
		t.Fatal(refused)
	}
}

// shut is a policy that lets `active` send nothing.
func shut(t *testing.T) *networkingv1.NetworkPolicy {
	return policyOf(t, "shut", `{podSelector: {matchLabels: {instance: active}}, policyTypes: [Egress]}`)
}

func TestInModeEstablishedAFlowLivesOnUntilItsPodIsDeleted(t *testing.T) {
	for _, protocol := range []string{"udp", "tcp"} {
		t.Run(protocol, func(t *testing.T) {
			w := newWorld(t)
			w.enforce(t)
			flow := w.open(t, protocol, "active", "robot", netip.Addr{})
			w.inMode(t, `{"established": true}`)
			w.setPolicy(t, shut(t))
			flow.expect("after the deny", true)
			w.expect(t, flows("active -> robot udp/7950", "active -> robot tcp/80"), false) // new flows
			w.inMode(t, `{}`)
			flow.expect("without the mode", false)
			w.inMode(t, `{"established": true}`)
			flow.expect("in the mode again", true)
			from := len(w.nodes[0].seen())
			w.api.remove(t, w.pod("active"))
			w.nodes[0].wait(t, from, func(c enforcer.Commit) bool { return c.Causes[0].Name == "active" })
			flow.expect("after the pod was deleted", false)
		})
	}
}

// heardSince returns whether messages of a sender arrive that are sent from now on, for so long.
func (s *stream) heardFor(arrived func() []arrival, from string, wait time.Duration) bool {
	now := time.Now()
	time.Sleep(wait)
	return slices.ContainsFunc(arrived(), func(a arrival) bool { return a.from == from && a.at.After(now.Add(20*time.Millisecond)) })
}

// TestInModeEstablishedAFlowThatIsNeverAnsweredLivesOn is about what a DDS writer sends: no packet of its flow comes back.
func TestInModeEstablishedAFlowThatIsNeverAnsweredLivesOn(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	arrived := w.record("robot")
	s := w.stream(t, "active", "robot", 7950, time.Millisecond)
	w.heardFrom(t, "robot", "active", time.Now())
	w.inMode(t, `{"established": true}`)
	w.setPolicy(t, shut(t))
	if !s.heardFor(arrived, "active", 300*time.Millisecond) {
		t.Error("the flow has ended")
	}
	late := w.stream(t, "standby", "robot", 7950, time.Millisecond)
	w.heardFrom(t, "robot", "standby", time.Now())
	w.setPolicy(t, policyOf(t, "shut", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress]}`))
	w.inMode(t, `{}`)
	if s.heardFor(arrived, "active", 300*time.Millisecond) || late.heardFor(arrived, "standby", 300*time.Millisecond) {
		t.Error("a flow goes on without the mode")
	}
	s.stop()
	late.stop()
}

func TestADeafNodeAppliesWhatItMissedWhenItHearsAgain(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.inMode(t, `{"deaf": true}`)
	object := shut(t)
	object.ResourceVersion = w.version()
	w.api.set(t, object)
	w.nodes[1].wait(t, 0, caused("NetworkPolicy", object.ResourceVersion))
	time.Sleep(100 * time.Millisecond)
	w.expect(t, flows("active -> robot udp/7950"), true)
	w.nodes[0].halt()
	w.launch(t, w.nodes[0]) // deaf from its first moment on
	time.Sleep(300 * time.Millisecond)
	w.expect(t, flows("active -> robot udp/7950"), true)
	from := len(w.nodes[0].seen())
	w.inMode(t, `{}`)
	w.nodes[0].wait(t, from, caused("NetworkPolicy", object.ResourceVersion))
	w.expect(t, flows("active -> robot udp/7950"), false)
}

func TestChangesLagByTheTimeOfTheNode(t *testing.T) {
	const lag = 400 * time.Millisecond
	w := newWorld(t)
	w.enforce(t)
	w.inMode(t, `{"lagMilliseconds": 400}`)
	arrived := w.record("robot")
	s := w.stream(t, "active", "robot", 7950, time.Millisecond)
	w.heardFrom(t, "robot", "active", time.Now())
	asked := time.Now()
	commits := w.setPolicy(t, shut(t))
	s.stop()
	time.Sleep(50 * time.Millisecond)
	if applied := commits[0].Committed.Sub(asked); applied < lag || applied > lag+300*time.Millisecond {
		t.Errorf("the node that lags applied the change after %v", applied)
	}
	if applied := commits[1].Committed.Sub(asked); applied >= lag {
		t.Errorf("the other node lags too: %v", applied)
	}
	var last time.Duration
	for _, a := range arrived() {
		last = max(last, s.sent[a.number].Sub(asked))
	}
	if last < lag/2 { // a busy machine may not send for a while
		t.Errorf("the last packet was let through %v after the change, before the lag was over", last)
	}
	// Two changes within the lag keep their distance, and without the mode what waits is applied.
	from := len(w.nodes[0].seen())
	w.api.remove(t, shut(t))
	w.inMode(t, `{}`)
	w.nodes[0].wait(t, from, func(c enforcer.Commit) bool {
		return slices.ContainsFunc(c.Causes, func(c enforcer.Cause) bool { return c.Name == "shut" && c.Event == "delete" })
	})
}

func TestAVanishedPodKeepsItsLastPolicyUntilItsNetworkIsGone(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.writeSandbox(t, w.hosts["active"], "pods-a", "uid-of-active")
	standby, gate := workloadPolicies(t, "nav", "active")
	w.setPolicy(t, standby)
	w.setPolicy(t, gate)
	w.inMode(t, `{"keepVanished": true}`)
	w.expect(t, flows("active -> robot udp/7950"), true)
	w.expect(t, flows("standby -> robot udp/7950"), false)
	remove := func(name string) {
		t.Helper()
		from := len(w.nodes[0].seen())
		w.api.remove(t, w.pod(name))
		w.nodes[0].wait(t, from, func(c enforcer.Commit) bool { return c.Causes[0].Name == name })
	}
	w.api.remove(t, w.pod("active"))
	time.Sleep(100 * time.Millisecond)
	_, gate = workloadPolicies(t, "nav", "standby")
	w.setPolicy(t, gate)
	w.expect(t, flows("active -> robot udp/7950", "standby -> robot udp/7950"), true)
	// A pod without a network on this node is forgotten like without the mode.
	remove("camera")
	w.expect(t, flows("camera -> robot udp/7950"), false)
	from := len(w.nodes[0].seen())
	must(t, os.Remove(filepath.Join(w.nodes[0].results, "pods-a")))
	w.nodes[0].wait(t, from, func(c enforcer.Commit) bool { return c.Causes[0].Kind == "Sandbox" })
	w.expect(t, flows("active -> robot udp/7950"), false)
}

func TestAVanishedPodIsForgottenWhenTheModeEnds(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.writeSandbox(t, w.hosts["active"], "pods-a", "uid-of-active")
	w.inMode(t, `{"keepVanished": true}`)
	w.api.remove(t, w.pod("active"))
	time.Sleep(100 * time.Millisecond)
	w.expect(t, flows("active -> robot udp/7950"), true)
	w.inMode(t, `{}`)
	w.expect(t, flows("active -> robot udp/7950"), false)
}

// labelLag is that of the tests below, in which each step takes a few milliseconds.
const labelLag = 2 * time.Second

// relabel changes labels of a pod of node 0, and returns the version and the time of the change.
func (w *world) relabel(t *testing.T, name string, labels map[string]string) (version string, asked time.Time) {
	t.Helper()
	pod := w.pod(name)
	maps.Copy(pod.Labels, labels)
	pod.ResourceVersion = w.version()
	asked = time.Now()
	w.api.set(t, pod)
	return pod.ResourceVersion, asked
}

// expectDue waits for the commit with a change, which is due after the lag.
func (w *world) expectDue(t *testing.T, from int, kind, version string, asked time.Time) {
	t.Helper()
	applied := w.nodes[0].wait(t, from, caused(kind, version)).Committed.Sub(asked)
	if applied < labelLag || applied > labelLag+400*time.Millisecond {
		t.Errorf("the labels were applied after %v", applied)
	}
}

// closed is a policy that lets pods with these labels send nothing.
func closed(t *testing.T, name, labels string) *networkingv1.NetworkPolicy {
	return policyOf(t, name, fmt.Sprintf(`{podSelector: {matchLabels: {%s}}, policyTypes: [Egress]}`, labels))
}

func TestAChangeOfLabelsLags(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, closed(t, "by-label", "instance: shut"))
	w.setPolicy(t, policyOf(t, "by-peer", `{podSelector: {matchLabels: {app: robot}}, policyTypes: [Ingress], ingress: [
		{from: [{podSelector: {matchExpressions: [{key: instance, operator: NotIn, values: [shut]}]}}]}]}`))
	for node := range w.nodes {
		if refused := w.setModes(t, node, `{"labelLagSeconds": 2}`); refused != "" {
			t.Fatal(refused)
		}
	}
	from := len(w.nodes[0].seen())
	version, asked := w.relabel(t, "active", map[string]string{"instance": "shut"})
	w.expect(t, flows("active -> robot udp/7950", "active -> dashboard udp/7950"), true)
	w.expectDue(t, from, "Pod", version, asked)
	w.expect(t, flows("active -> robot udp/7950", "active -> dashboard udp/7950"), false)
}

// TestWhileLabelsLagNoPolicyOfThePodChanges is what Cilium does until it knows the identity of the new labels.
func TestWhileLabelsLagNoPolicyOfThePodChanges(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	toRobot := func(port int) *networkingv1.NetworkPolicy {
		return policyOf(t, "rules", fmt.Sprintf(`{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress], egress: [
			{to: [{podSelector: {matchLabels: {app: robot}}}], ports: [{port: %d, protocol: UDP}]}]}`, port))
	}
	open := policyOf(t, "deleted", `{podSelector: {matchLabels: {instance: active}}, policyTypes: [Egress], egress: [{ports: [{port: 80}]}]}`)
	w.setPolicy(t, toRobot(7950))
	w.setPolicy(t, closed(t, "selector", "app: none"))
	w.setPolicy(t, open)
	w.inMode(t, `{"labelLagSeconds": 2}`)
	from := len(w.nodes[0].seen())
	version, asked := w.relabel(t, "active", map[string]string{"note": "unrelated"})
	w.setPolicy(t, toRobot(7949))
	w.setPolicy(t, closed(t, "selector", "app: camera"))
	w.setPolicy(t, policyOf(t, "new", `{podSelector: {matchLabels: {instance: active}}, policyTypes: [Egress], egress: [{ports: [{port: 8000}]}]}`))
	w.deletePolicy(t, open)
	before, after := flows("active -> robot udp/7950", "active -> robot tcp/80"), flows("active -> robot udp/7949", "active -> robot tcp/8000")
	w.expect(t, before, true)
	w.expect(t, after, false)
	w.expect(t, flows("standby -> robot udp/7949"), true)
	w.expect(t, flows("standby -> robot udp/7950", "camera -> robot udp/7950"), false)
	if took := time.Since(asked); took > labelLag {
		t.Skipf("the machine is too busy: this took %v", took)
	}
	w.expectDue(t, from, "Pod", version, asked)
	w.expect(t, before, false)
	w.expect(t, after, true)
}

func TestALabelThatBeginsWithAnnotationDoesNotLag(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, closed(t, "by-label", "annotation.example.com/by: me"))
	w.inMode(t, `{"labelLagSeconds": 60}`)
	from := len(w.nodes[0].seen())
	version, _ := w.relabel(t, "active", map[string]string{"annotation.example.com/by": "me"})
	w.nodes[0].wait(t, from, caused("Pod", version))
	w.expect(t, flows("active -> robot udp/7950"), false)
	w.setPolicy(t, closed(t, "by-label", "app: camera"))
	w.expect(t, flows("active -> robot udp/7950"), true)
	// It does not prolong the lag of other labels, and is in force after it.
	w.inMode(t, `{"labelLagSeconds": 2}`)
	version, asked := w.relabel(t, "active", map[string]string{"note": "unrelated"})
	from = len(w.nodes[0].seen())
	time.Sleep(labelLag / 2)
	w.relabel(t, "active", map[string]string{"note": "unrelated", "annotation.example.com/by": "you"})
	w.setPolicy(t, closed(t, "by-label", "annotation.example.com/by: you"))
	w.expectDue(t, from, "Pod", version, asked)
	w.expect(t, flows("active -> robot udp/7950"), false)
}

func TestAChangeOfLabelsOfANamespaceLagsForAllOfItsPods(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "by-namespace", `{podSelector: {matchLabels: {app: camera}}, policyTypes: [Egress], egress: [
		{to: [{namespaceSelector: {matchLabels: {team: robots}}, podSelector: {}}]}]}`))
	w.inMode(t, `{"labelLagSeconds": 2}`)
	namespace := w.table.NamespaceObjects()[slices.IndexFunc(w.table.NamespaceObjects(), func(n *corev1.Namespace) bool { return n.Name == "fleet" })]
	namespace.Labels["team"], namespace.ResourceVersion = "none", w.version()
	from, asked := len(w.nodes[0].seen()), time.Now()
	w.api.set(t, namespace)
	again := namespace.DeepCopy()
	again.ResourceVersion, again.Annotations = w.version(), map[string]string{"note": "no change of labels"}
	w.api.set(t, again)
	w.setPolicy(t, shut(t))
	w.expect(t, flows("active -> robot udp/7950", "camera -> robot udp/7950"), true)
	w.expectDue(t, from, "Namespace", namespace.ResourceVersion, asked)
	w.expect(t, flows("active -> robot udp/7950", "camera -> robot udp/7950"), false)
}

func TestModesThatAreNotKnownAreRefused(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, shut(t))
	for text, want := range map[string]string{
		`{"deff": true}`:             `unknown field "deff"`,
		`{"deaf": "yes"}`:            "cannot unmarshal string",
		`{"lagMilliseconds": -5}`:    "cannot unmarshal number",
		`{"labelLagSeconds": -5}`:    "negative",
		`{"established": true} more`: "nothing after it",
		`established`:                "invalid character",
	} {
		if refused := w.setModes(t, 0, text); !strings.Contains(refused, want) {
			t.Errorf("%s: refused with %q, want %q", text, refused, want)
		}
	}
	w.expect(t, flows("active -> robot udp/7950"), false)
}
