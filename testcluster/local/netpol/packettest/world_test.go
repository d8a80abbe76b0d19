package packettest

import (
	"context"
	"flag"
	"fmt"
	"io"
	"log/slog"
	"net/netip"
	"os"
	"os/exec"
	"slices"
	"strconv"
	"sync"
	"testing"
	"time"

	corev1 "k8s.io/api/core/v1"
	networkingv1 "k8s.io/api/networking/v1"
	"k8s.io/klog/v2"

	"understudy/testcluster/understudy-netpol/conformance"
	"understudy/testcluster/understudy-netpol/internal/enforcer"
)

func TestMain(m *testing.M) {
	flag.Parse()
	if out, err := exec.Command("unshare", "--net", "true").CombinedOutput(); err != nil {
		fmt.Printf("packettest: SKIPPED, network namespaces cannot be made here (that needs root and util-linux): %v %s\n", err, out)
		return
	}
	for program, pkg := range map[string]string{"ip": "iproute2", "nft": "nftables", "nsenter": "util-linux"} {
		if _, err := exec.LookPath(program); err != nil {
			fmt.Printf("packettest: there is no %s: apt-get install %s\n", program, pkg)
			os.Exit(1)
		}
	}
	if !testing.Verbose() {
		slog.SetDefault(slog.New(slog.NewJSONHandler(io.Discard, nil)))
	}
	klog.SetSlogLogger(slog.Default())
	m.Run()
}

// world has the network namespaces, nodes and API of a test.
type world struct {
	table  *conformance.Table
	lan    *namespace
	nodes  [2]*node
	hosts  map[string]*host // pods and the one outside
	api    *fakeAPI
	serial int
}

type node struct {
	name string
	*namespace
	stop    context.CancelFunc
	stopped chan struct{}
	results string // directory of CNI results
	modes   string // file of modes

	mu      sync.Mutex
	commits []enforcer.Commit
	grown   chan struct{}
}

// host is a pod, or the host outside. It can send and answer.
type host struct {
	name string
	*namespace
	addrs [2]netip.Addr // IPv4 and IPv6
	node  int           // -1 for the one outside
	*listeners
}

// newWorld lays cables as a ptp CNI does: every pod has a host route on its node, and its node is its gateway.
func newWorld(t testing.TB) *world {
	t.Helper()
	table, err := conformance.Load()
	if err != nil {
		t.Fatal(err)
	}
	dir := t.TempDir()
	w := &world{table: table, hosts: map[string]*host{}, lan: newNamespace(t, dir, "lan")}
	w.lan.ip(t, "link add br0 type bridge", "link set br0 up")
	for i := range w.nodes {
		n := &node{name: fmt.Sprint("node", i), namespace: newNamespace(t, dir, fmt.Sprint("node", i)), grown: make(chan struct{})}
		n.results, n.modes = fmt.Sprintf("%s/results%d", dir, i), fmt.Sprintf("%s/modes%d", dir, i)
		w.nodes[i] = n
		w.plug(t, n.namespace, fmt.Sprintf("192.0.2.1%d/24", i+1), fmt.Sprintf("fd00:2::1%d/64", i+1))
		n.sysctl(t, "ipv4/ip_forward=1", "ipv6/conf/all/forwarding=1", "ipv4/icmp_ratelimit=0")
		other := 2 - i
		n.ip(t, fmt.Sprintf("route add 10.199.%d.0/24 via 192.0.2.1%d", other, other), fmt.Sprintf("route add fd00:%d::/64 via fd00:2::1%d", 0x100+other, other))
	}
	outside := &host{name: conformance.Outside, namespace: newNamespace(t, dir, "outside"), node: -1}
	outside.addrs = [2]netip.Addr{netip.MustParseAddr("192.0.2.20"), netip.MustParseAddr("fd00:2::20")}
	w.plug(t, outside.namespace, "192.0.2.20/24", "fd00:2::20/64")
	for i := range w.nodes {
		outside.ip(t, fmt.Sprintf("route add 10.199.%d.0/24 via 192.0.2.1%d", i+1, i+1), fmt.Sprintf("route add fd00:%d::/64 via fd00:2::1%d", 0x100+i+1, i+1))
	}
	w.hosts[outside.name] = outside
	for i, pod := range table.Pods {
		w.addHost(t, dir, pod.Name, pod.Node, i+2)
	}
	for _, h := range w.hosts {
		h.listeners = listen(t, h.namespace)
	}
	w.api = newAPI(t)
	for _, namespace := range table.NamespaceObjects() {
		w.api.set(t, namespace)
	}
	for _, pod := range table.Pods {
		w.api.set(t, w.podObject(pod))
	}
	return w
}

func (w *world) plug(t testing.TB, n *namespace, addr4, addr6 string) {
	port := fmt.Sprint("port", len(w.hosts)*10+w.serial)
	w.serial++
	w.lan.ip(t, fmt.Sprintf("link add %s type veth peer name eth0 netns %s", port, n.path), fmt.Sprintf("link set %s master br0 up", port))
	n.ip(t, "link set lo up", "link set eth0 up", "addr add "+addr4+" dev eth0", "addr add "+addr6+" dev eth0 nodad")
}

func (w *world) addHost(t testing.TB, dir, name string, on, number int) *host {
	t.Helper()
	n := w.nodes[on]
	h := &host{name: name, namespace: newNamespace(t, dir, "pod-"+name), node: on}
	h.addrs[0] = netip.MustParseAddr(fmt.Sprintf("10.199.%d.%d", on+1, number))
	h.addrs[1] = netip.MustParseAddr(fmt.Sprintf("fd00:%d::%d", 0x100+on+1, number))
	veth := fmt.Sprint("veth", number)
	n.ip(t, fmt.Sprintf("link add %s type veth peer name eth0 netns %s", veth, h.path), fmt.Sprintf("link set %s up", veth),
		fmt.Sprintf("addr add 10.199.%d.1/32 dev %s", on+1, veth), fmt.Sprintf("addr add fd00:%d::1/128 dev %s nodad", 0x100+on+1, veth),
		fmt.Sprintf("route add %s/32 dev %s", h.addrs[0], veth), fmt.Sprintf("route add %s/128 dev %s", h.addrs[1], veth))
	h.ip(t, "link set lo up", "link set eth0 up",
		fmt.Sprintf("addr add %s/32 dev eth0", h.addrs[0]), fmt.Sprintf("addr add %s/128 dev eth0 nodad", h.addrs[1]),
		fmt.Sprintf("route add 10.199.%d.1 dev eth0", on+1), fmt.Sprintf("route add default via 10.199.%d.1 dev eth0", on+1),
		fmt.Sprintf("route add fd00:%d::1 dev eth0", 0x100+on+1), fmt.Sprintf("route add ::/0 via fd00:%d::1 dev eth0", 0x100+on+1))
	w.hosts[name] = h
	return h
}

func (w *world) podObject(pod conformance.Pod) *corev1.Pod {
	h := w.hosts[pod.Name]
	return pod.Object(w.nodes[pod.Node].name, h.addrs[0].String(), h.addrs[1].String())
}

func (w *world) address(name string) string { return w.hosts[name].addrs[0].String() }

// enforce starts the enforcers of both nodes and waits until they are in force.
func (w *world) enforce(t testing.TB) {
	t.Helper()
	for i := range w.nodes {
		w.startNode(t, i)
	}
}

func (w *world) startNode(t testing.TB, i int) {
	t.Helper()
	n := w.nodes[i]
	before, seen := w.api.begun(), len(n.seen())
	w.launch(t, n)
	w.api.waitBegun(t, before+3) // the fake API loses what happens between a list and its watch
	n.wait(t, seen, func(c enforcer.Commit) bool {
		return slices.ContainsFunc(c.Causes, func(c enforcer.Cause) bool { return c.Event == "synced" })
	})
}

func (w *world) launch(t testing.TB, n *node) {
	t.Helper()
	report := enforcer.NewReport()
	report.Observe = n.observe
	ctx, cancel := context.WithCancel(context.Background())
	n.stop, n.stopped = cancel, make(chan struct{})
	engine := enforcer.New(enforcer.Options{Node: n.name, PodInterfaces: "veth", CNIResults: n.results, Reconcile: 250 * time.Millisecond, Modes: n.modes, Netns: n.file}, report)
	go func() {
		defer close(n.stopped)
		if err := engine.Run(ctx, w.api.api()); err != nil {
			t.Error(err)
		}
	}()
	t.Cleanup(func() { n.halt() })
}

func (n *node) halt() {
	if n.stop != nil {
		n.stop()
		<-n.stopped
		n.stop = nil
	}
}

func (n *node) observe(c enforcer.Commit) {
	n.mu.Lock()
	n.commits = append(n.commits, c)
	close(n.grown)
	n.grown = make(chan struct{})
	n.mu.Unlock()
}

func (n *node) seen() []enforcer.Commit {
	n.mu.Lock()
	defer n.mu.Unlock()
	return n.commits
}

// wait returns the first commit from the given one on that fits.
func (n *node) wait(t testing.TB, from int, fits func(enforcer.Commit) bool) enforcer.Commit {
	t.Helper()
	deadline := time.After(10 * time.Second)
	for {
		n.mu.Lock()
		list, grown := n.commits[from:], n.grown
		n.mu.Unlock()
		for _, c := range list {
			if fits(c) {
				return c
			}
		}
		select {
		case <-grown:
		case <-deadline:
			t.Fatalf("%s: no such commit after 10 s", n.name)
		}
	}
}

func caused(kind, version string) func(enforcer.Commit) bool {
	return func(c enforcer.Commit) bool {
		for _, cause := range c.Causes {
			if cause.Kind == kind && cause.ResourceVersion == version {
				return true
			}
		}
		return false
	}
}

func (w *world) version() string {
	w.serial++
	return strconv.Itoa(w.serial)
}

// setPolicy creates or replaces a policy; commits tells, per node, when it was in force.
func (w *world) setPolicy(t testing.TB, object *networkingv1.NetworkPolicy) (commits [2]enforcer.Commit) {
	t.Helper()
	object = object.DeepCopy()
	object.ResourceVersion = w.version()
	from := [2]int{len(w.nodes[0].seen()), len(w.nodes[1].seen())}
	w.api.set(t, object)
	for i, n := range w.nodes {
		commits[i] = n.wait(t, from[i], caused("NetworkPolicy", object.ResourceVersion))
	}
	return commits
}

// setPolicies makes these the only policies.
func (w *world) setPolicies(t testing.TB, objects []*networkingv1.NetworkPolicy) {
	t.Helper()
	wanted := map[string]bool{}
	for _, object := range objects {
		wanted[object.Namespace+"/"+object.Name] = true
	}
	for _, old := range w.api.policies(t) {
		if !wanted[old.Namespace+"/"+old.Name] {
			w.deletePolicy(t, &old)
		}
	}
	for _, object := range objects {
		w.setPolicy(t, object)
	}
}

func (w *world) deletePolicy(t testing.TB, object *networkingv1.NetworkPolicy) {
	t.Helper()
	from := [2]int{len(w.nodes[0].seen()), len(w.nodes[1].seen())}
	w.api.remove(t, object)
	for i, n := range w.nodes {
		n.wait(t, from[i], func(c enforcer.Commit) bool {
			for _, cause := range c.Causes {
				if cause.Kind == "NetworkPolicy" && cause.Name == object.Name && cause.Event == "delete" {
					return true
				}
			}
			return false
		})
	}
}

// setPod creates or replaces a pod and waits until a node has taken notice.
func (w *world) setPod(t testing.TB, object *corev1.Pod, noticed int) {
	t.Helper()
	object.ResourceVersion = w.version()
	from := len(w.nodes[noticed].seen())
	w.api.set(t, object)
	w.nodes[noticed].wait(t, from, caused("Pod", object.ResourceVersion))
}

func (w *world) pod(name string) *corev1.Pod {
	for _, pod := range w.table.Pods {
		if pod.Name == name {
			return w.podObject(pod)
		}
	}
	panic("no pod " + name)
}

func must(t testing.TB, err error) {
	t.Helper()
	if err != nil {
		t.Fatal(err)
	}
}
