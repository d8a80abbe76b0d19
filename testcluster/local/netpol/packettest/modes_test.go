package packettest

import (
	"encoding/json"
	"net/netip"
	"os"
	"path/filepath"
	"slices"
	"strings"
	"testing"
	"time"

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

func TestAChangeOfLabelsLagsAndNothingElseDoes(t *testing.T) {
	const lag = 600 * time.Millisecond
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {instance: shut}}, policyTypes: [Egress]}`))
	w.inMode(t, `{"labelLagSeconds": 0.6}`)
	pod := w.pod("active")
	pod.Labels["instance"], pod.ResourceVersion = "shut", w.version()
	from, asked := len(w.nodes[0].seen()), time.Now()
	w.api.set(t, pod)
	commits := w.setPolicy(t, policyOf(t, "other", `{podSelector: {matchLabels: {app: camera}}, policyTypes: [Egress]}`))
	if applied := commits[0].Committed.Sub(asked); applied >= lag {
		t.Errorf("a policy lags too: %v", applied)
	}
	w.expect(t, flows("active -> robot udp/7950"), true)
	commit := w.nodes[0].wait(t, from, caused("Pod", pod.ResourceVersion))
	if applied := commit.Committed.Sub(asked); applied < lag || applied > lag+400*time.Millisecond {
		t.Errorf("the labels were applied after %v", applied)
	}
	w.expect(t, flows("active -> robot udp/7950"), false)
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
