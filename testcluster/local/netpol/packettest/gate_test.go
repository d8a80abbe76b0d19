package packettest

import (
	"fmt"
	"math"
	"slices"
	"testing"
	"time"

	corev1 "k8s.io/api/core/v1"
	networkingv1 "k8s.io/api/networking/v1"
)

// workloadPolicies are the two policies of a workload's gate, as Understudy writes them.
func workloadPolicies(t testing.TB, workload, open string) (standby, gate *networkingv1.NetworkPolicy) {
	others := fmt.Sprintf(`{namespaceSelector: {}, podSelector: {matchExpressions: [{key: app, operator: NotIn, values: [%s]}]}}`, workload)
	standby = policyOf(t, workload+"-standby", fmt.Sprintf(`{podSelector: {matchLabels: {app: %s}}, policyTypes: [Ingress, Egress], ingress: [{from: [%s]}],
		egress: [{to: [%s], ports: [{port: 1, endPort: 65535}, {protocol: UDP, port: 1, endPort: 7949}, {protocol: UDP, port: 8150, endPort: 65535}]}]}`, workload, others, others))
	gate = policyOf(t, workload+"-gate", fmt.Sprintf(`{podSelector: {matchLabels: {app: %s, instance: %s}}, policyTypes: [Egress], egress: [{}]}`, workload, open))
	return standby, gate
}

// crowd fills node 0 with pods that have addresses only, three to a workload, each workload with its gate.
func (w *world) crowd(t *testing.T, pods int) {
	for i := range pods {
		workload, instance := fmt.Sprint("w", i/3), []string{"a", "b", "robot"}[i%3]
		pod := &corev1.Pod{Spec: corev1.PodSpec{NodeName: "node0"}, Status: corev1.PodStatus{Phase: corev1.PodRunning, PodIPs: []corev1.PodIP{{IP: fmt.Sprintf("10.199.1.%d", 100+i)}}}}
		pod.Namespace, pod.Name = "fleet", fmt.Sprintf("%s-%s", workload, instance)
		pod.Labels = map[string]string{"app": workload, "instance": instance}
		if instance == "robot" {
			pod.Labels["app"] = "robot-of-" + workload
		}
		w.api.set(t, pod)
		if i%3 == 0 {
			standby, gate := workloadPolicies(t, workload, "a")
			w.api.set(t, standby)
			w.api.set(t, gate)
		}
	}
}

const flips = 200

// heardFrom waits until something has arrived that was sent after the given time; a busy machine may not send for a while.
func (w *world) heardFrom(t *testing.T, receiver, sender string, after time.Time) {
	t.Helper()
	l := w.hosts[receiver].listeners
	for end := time.Now().Add(2 * time.Second); time.Now().Before(end); time.Sleep(time.Millisecond) {
		l.mu.Lock()
		last := l.last[sender]
		l.mu.Unlock()
		if last.After(after) {
			return
		}
	}
	t.Errorf("nothing of %s arrives although the gate is open for it", sender)
}

// TestTheGateUnderFire flips a gate between two senders that both never stop, with 60 more pods and 20 more workloads on
// the node, and judges by the messages that the receiver got.
func TestTheGateUnderFire(t *testing.T) {
	w := newWorld(t)
	w.crowd(t, 60)
	standby, _ := workloadPolicies(t, "nav", "")
	gates := map[string]*networkingv1.NetworkPolicy{}
	for _, name := range []string{"active", "standby"} {
		_, gates[name] = workloadPolicies(t, "nav", name)
	}
	w.api.set(t, standby)
	w.api.set(t, gates["active"].DeepCopy())
	w.enforce(t)
	for receiver, where := range map[string]string{"robot": "on another node", "camera": "on the same node"} {
		t.Run("receiver "+where, func(t *testing.T) { w.flip(t, receiver, gates) })
	}
}

// turn is one flip: when its gate was requested, when it was in force, and when the next gate was requested.
type turn struct {
	to                string
	asked, committed  time.Time
	latency           time.Duration
	ends              time.Time
	lastOld, firstNew time.Duration
}

func (w *world) flip(t *testing.T, receiver string, gates map[string]*networkingv1.NetworkPolicy) {
	arrived := w.record(receiver)
	streams := map[string]*stream{}
	for name := range gates {
		streams[name] = w.stream(t, name, receiver, 7950, 300*time.Microsecond)
	}
	var turns []*turn
	for i := range flips {
		to := []string{"standby", "active"}[i%2]
		object := gates[to].DeepCopy()
		object.ResourceVersion = w.version()
		from := len(w.nodes[0].seen())
		now := &turn{to: to, asked: time.Now()}
		if i > 0 {
			turns[i-1].ends = now.asked
		}
		w.api.set(t, object)
		commit := w.nodes[0].wait(t, from, caused("NetworkPolicy", object.ResourceVersion))
		now.committed, now.latency = commit.Committed, commit.Latency()
		turns = append(turns, now)
		w.heardFrom(t, receiver, to, now.committed)
		time.Sleep(5 * time.Millisecond)
	}
	turns[flips-1].ends = time.Now()
	for _, s := range streams {
		s.stop()
	}
	time.Sleep(50 * time.Millisecond)
	judge(t, turns, streams, arrived())
}

func judge(t *testing.T, turns []*turn, streams map[string]*stream, arrivals []arrival) {
	leaked, both, unclear, silent := 0, 0, 0, 0
	for _, now := range turns {
		var firstNew *arrival
		for i := range arrivals {
			a := &arrivals[i]
			sent := streams[a.from].sent[a.number]
			if sent.Before(now.asked) || !sent.Before(now.ends) {
				continue
			}
			switch {
			case a.from == now.to && firstNew == nil:
				firstNew = a
				now.firstNew = sent.Sub(now.asked)
			case a.from != now.to:
				if !sent.After(now.committed) {
					now.lastOld = sent.Sub(now.asked)
				}
				switch {
				case !sent.After(now.committed):
				case a.at.After(now.ends):
					unclear++ // the clock was read in this turn, but the packet may have been sent in the next
				default:
					leaked++
					if firstNew != nil && sent.After(firstNew.at) {
						both++
					}
				}
			}
		}
		if firstNew == nil {
			silent++
		}
	}
	t.Logf("%d flips, %d packets arrived; %d sent after the commit by the sender shut out; %d times both; %d on the border to the next flip; %d flips without a packet of the new one",
		len(turns), len(arrivals), leaked, both, unclear, silent)
	if leaked > 0 || both > 0 || silent > 0 || unclear > len(turns)/10 {
		t.Error("the gate does not hold")
	}
	figure := func(name string, of func(*turn) time.Duration) {
		values := make([]time.Duration, len(turns))
		for i, now := range turns {
			values[i] = of(now)
		}
		slices.Sort(values)
		at := func(q float64) time.Duration {
			return values[int(math.Ceil(q*float64(len(values))))-1].Round(time.Microsecond)
		}
		t.Logf("%-58s p50 %8v  p95 %8v  max %8v", name, at(0.5), at(0.95), at(1))
	}
	figure("receipt of the change to the kernel's confirmation", func(n *turn) time.Duration { return n.latency })
	figure("change asked for to the kernel's confirmation", func(n *turn) time.Duration { return n.committed.Sub(n.asked) })
	figure("change asked for to the last packet let through of the old", func(n *turn) time.Duration { return n.lastOld })
	figure("change asked for to the first packet let through of the new", func(n *turn) time.Duration { return n.firstNew })
}
