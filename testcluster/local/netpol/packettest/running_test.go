package packettest

import (
	"fmt"
	"net"
	"net/netip"
	"strings"
	"sync"
	"testing"
	"time"

	"golang.org/x/sys/unix"

	"understudy/testcluster/understudy-netpol/internal/enforcer"
	"understudy/testcluster/understudy-netpol/internal/nft"
)

// stream sends numbered messages to a port until it is stopped.
type stream struct {
	conn net.Conn
	sent []time.Time // the clock just before message n was sent
	quit chan struct{}
	done chan struct{}
}

func (w *world) stream(t *testing.T, from, to string, port uint16, every time.Duration) *stream {
	t.Helper()
	conn, err := w.hosts[from].dial("udp", netip.AddrPortFrom(w.hosts[to].addrs[0], port), 0)
	must(t, err)
	s := &stream{conn: conn, quit: make(chan struct{}), done: make(chan struct{})}
	go func() {
		defer close(s.done)
		pause := unix.NsecToTimespec(every.Nanoseconds())
		for {
			select {
			case <-s.quit:
				return
			default:
				unix.Nanosleep(&pause, nil) // Go's own timers are no finer than a millisecond
				s.sent = append(s.sent, time.Now())
				fmt.Fprintf(conn, "%s %d", from, len(s.sent)-1)
			}
		}
	}()
	t.Cleanup(func() { conn.Close() })
	return s
}

func (s *stream) stop() {
	close(s.quit)
	<-s.done
}

// arrival is a message of a stream at its destination.
type arrival struct {
	from   string
	number int
	at     time.Time
}

// record keeps all that arrives at a host, until the test ends.
func (w *world) record(at string) func() []arrival {
	var mu sync.Mutex
	var list []arrival
	l := w.hosts[at].listeners
	l.mu.Lock()
	l.hook = func(_ netip.AddrPort, text string, at time.Time) {
		a := arrival{at: at}
		if _, err := fmt.Sscanf(text, "%s %d", &a.from, &a.number); err == nil {
			mu.Lock()
			list = append(list, a)
			mu.Unlock()
			l.mu.Lock()
			l.last[a.from] = at
			l.mu.Unlock()
		}
	}
	l.mu.Unlock()
	return func() []arrival {
		mu.Lock()
		defer mu.Unlock()
		return list
	}
}

const restarts = 20

// TestARestartTouchesNothing restarts the enforcer under fire. The new one finds the table as it should be.
func TestARestartTouchesNothing(t *testing.T) {
	passed, sent := restartUnderFire(t, func(_ *node, changes nft.Changes) {
		if changes != (nft.Changes{}) {
			t.Errorf("a restart changed something: %+v", changes)
		}
	})
	if passed != sent {
		t.Errorf("%d of %d allowed packets arrived", passed, sent)
	}
}

// TestAReplacedTableLeaksNothing does the same with a table that cannot be adapted, so that it is written again each time.
// An allowed packet may be lost if it is judged at that very moment.
func TestAReplacedTableLeaksNothing(t *testing.T) {
	tampered := false
	passed, sent := restartUnderFire(t, func(n *node, changes nft.Changes) {
		if tampered && !changes.Full {
			t.Errorf("the table was not replaced: %+v", changes)
		}
		tampered = true
		n.nft(t, "chain inet understudy_netpol egress { policy drop; }")
	})
	if passed < sent-restarts {
		t.Errorf("%d of %d allowed packets arrived", passed, sent)
	}
}

// restartUnderFire returns how many allowed packets arrived and how many were sent; no denied packet may arrive.
func restartUnderFire(t *testing.T, each func(*node, nft.Changes)) (passed, sent int) {
	t.Helper()
	w := newWorld(t)
	w.enforce(t)
	n := w.nodes[0]
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress], egress: [{to: [{podSelector: {matchLabels: {app: robot}}}], ports: [{protocol: UDP, port: 1000}]}]}`))
	arrived := w.record("robot")
	denied := w.stream(t, "standby", "robot", 7950, 200*time.Microsecond)
	allowed := w.stream(t, "active", "robot", 1000, 200*time.Microsecond)
	for range restarts {
		n.halt()
		from := len(n.seen())
		w.startNode(t, 0)
		each(n, n.seen()[from].Changes)
	}
	denied.stop()
	allowed.stop()
	time.Sleep(50 * time.Millisecond)
	counts := map[string]int{}
	for _, a := range arrived() {
		counts[a.from]++
	}
	if counts["standby"] > 0 {
		t.Errorf("%d of %d packets of an isolated pod passed", counts["standby"], len(denied.sent))
	}
	t.Logf("%d restarts: %d of %d denied packets passed, %d of %d allowed ones", restarts, counts["standby"], len(denied.sent), counts["active"], len(allowed.sent))
	return counts["active"], len(allowed.sent)
}

func TestRulesStayWithoutTheEnforcerAndAreRemovedByCleanup(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress]}`))
	w.nodes[0].halt()
	w.expect(t, flows("active -> robot udp/7950"), false)
	w.expect(t, flows("camera -> robot udp/7950"), true)
	must(t, enforcer.Cleanup(w.nodes[0].file))
	w.expect(t, flows("active -> robot udp/7950"), true)
	must(t, enforcer.Cleanup(w.nodes[0].file)) // nothing there any more, and no error
}

func (n *node) nft(t *testing.T, command string) string {
	t.Helper()
	return n.run(t, command+"\n", "nft", "-f", "-")
}

// TestTheTableIsRepaired lets others tamper with the table; the enforcers of these tests compare four times a second.
func TestTheTableIsRepaired(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress], egress: [{to: [{podSelector: {matchLabels: {app: robot}}}], ports: [{protocol: UDP, port: 1000}]}]}`))
	// One of each kind of rule, all of which must be recognised when read back.
	w.setPolicy(t, policyOf(t, "kinds", `{podSelector: {matchLabels: {app: camera}}, policyTypes: [Ingress, Egress], ingress: [{from: [{ipBlock: {cidr: 10.0.0.0/8, except: [10.1.0.0/16]}}, {ipBlock: {cidr: "fd00::/8"}}], ports: [{port: web}, {protocol: UDP, port: 5, endPort: 9}, {protocol: SCTP}, {port: 7}]}, {from: [{namespaceSelector: {}}]}], egress: [{}]}`))
	n := w.nodes[0]
	n.nft(t, "table inet others { chain c { type filter hook forward priority 10; counter; }; }")
	for name, tamper := range map[string]string{
		"policy changed":   "chain inet understudy_netpol ingress { policy drop; }",
		"table deleted":    "delete table inet understudy_netpol",
		"chain flushed":    "flush chain inet understudy_netpol egress4",
		"rule added":       "insert rule inet understudy_netpol egress4 accept",
		"element deleted":  "delete element inet understudy_netpol egress4 { " + w.address("active") + " }",
		"element added":    "add element inet understudy_netpol self4 { " + w.address("active") + " . " + w.address("camera") + " }",
		"set added":        "add set inet understudy_netpol other { type ipv4_addr; }",
		"everything added": "add chain inet understudy_netpol other; add rule inet understudy_netpol other counter",
	} {
		t.Run(name, func(t *testing.T) {
			from := len(n.seen())
			n.nft(t, tamper)
			n.wait(t, from, func(c enforcer.Commit) bool { return c.Causes[0].Event == "repair" })
			w.expect(t, flows("active -> robot udp/7950", "active -> camera udp/7950"), false)
			w.expect(t, flows("active -> robot udp/1000"), true)
		})
	}
	time.Sleep(600 * time.Millisecond)
	from := len(n.seen())
	time.Sleep(600 * time.Millisecond)
	if more := n.seen()[from:]; len(more) > 0 {
		t.Errorf("an untouched table was repaired: %+v", more)
	}
	if text := n.run(t, "", "nft", "list", "table", "inet", "others"); !strings.Contains(text, "counter") {
		t.Error("the table of others was touched")
	}
}

// TestARefusedTransactionIsMadeGood changes a policy right after the table was deleted by someone else: the kernel refuses
// the small change, and the enforcer writes everything again.
func TestARefusedTransactionIsMadeGood(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress]}`))
	w.nodes[0].nft(t, "delete table inet understudy_netpol")
	commits := w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {instance: standby}}, policyTypes: [Egress]}`))
	if !commits[0].Changes.Full {
		t.Error("the change was not made good by a full replacement")
	}
	w.expect(t, flows("standby -> robot udp/7950"), false)
	w.expect(t, flows("active -> robot udp/7950"), true)
}

// TestTheRulesOutliveTheAPI takes the API away, changes things meanwhile, and gives it back.
func TestTheRulesOutliveTheAPI(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "kept", `{podSelector: {matchLabels: {instance: standby}}, policyTypes: [Egress]}`))
	w.setPolicy(t, policyOf(t, "gone", `{podSelector: {matchLabels: {app: camera}}, policyTypes: [Egress]}`))
	before := w.api.begun()
	w.api.leave()
	object := policyOf(t, "new", `{podSelector: {matchLabels: {instance: active}}, policyTypes: [Egress]}`)
	object.ResourceVersion = w.version()
	w.api.set(t, object)
	w.api.remove(t, policyOf(t, "gone", `{}`))
	time.Sleep(700 * time.Millisecond)
	w.expect(t, flows("standby -> robot udp/7950", "camera -> robot udp/7950"), false)
	w.expect(t, flows("active -> robot udp/7950"), true)
	from := len(w.nodes[0].seen())
	w.api.comeBack()
	back := time.Now()
	w.nodes[0].wait(t, from, caused("NetworkPolicy", object.ResourceVersion))
	w.api.waitBegun(t, before+6)
	t.Logf("in step %v after the API was back", time.Since(back).Round(time.Millisecond))
	if time.Since(back) > 5*time.Second {
		t.Error("that is too long")
	}
	w.expect(t, flows("standby -> robot udp/7950", "active -> robot udp/7950"), false)
	w.expect(t, flows("camera -> robot udp/7950"), true)
	w.setPolicy(t, policyOf(t, "new", `{podSelector: {matchLabels: {instance: nobody}}, policyTypes: [Egress]}`))
	w.expect(t, flows("active -> robot udp/7950"), true)
}
