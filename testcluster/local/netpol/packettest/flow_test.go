package packettest

import (
	"fmt"
	"io"
	"math/rand/v2"
	"net"
	"net/netip"
	"testing"
	"time"

	networkingv1 "k8s.io/api/networking/v1"
	"sigs.k8s.io/yaml"
)

// policyOf reads a policy of the namespace fleet.
func policyOf(t testing.TB, name, spec string) *networkingv1.NetworkPolicy {
	t.Helper()
	object := &networkingv1.NetworkPolicy{}
	object.Namespace, object.Name = "fleet", name
	must(t, yaml.UnmarshalStrict([]byte(spec), &object.Spec))
	return object
}

// flow is a connection between two hosts, held at both ends.
type flow struct {
	t              *testing.T
	client, server net.Conn
}

// open establishes a connection to a port of its own. The client may be told another address than the server's.
func (w *world) open(t *testing.T, protocol, from, to string, told netip.Addr) *flow {
	t.Helper()
	client, server := w.hosts[from], w.hosts[to]
	port := uint16(20000 + rand.N(10000))
	if !told.IsValid() {
		told = server.addrs[0]
	}
	target := netip.AddrPortFrom(told, port)
	f := &flow{t: t}
	t.Cleanup(func() {
		if f.client != nil {
			f.client.Close()
		}
		if f.server != nil {
			f.server.Close()
		}
	})
	var err error
	if protocol == "udp" {
		f.client, err = client.dial("udp", target, 0)
		must(t, err)
		must(t, server.do(func() error {
			f.server, err = net.DialUDP("udp", &net.UDPAddr{Port: int(port)}, f.client.LocalAddr().(*net.UDPAddr))
			return err
		}))
	} else {
		var listener *net.TCPListener
		must(t, server.do(func() error {
			listener, err = net.ListenTCP("tcp", &net.TCPAddr{Port: int(port)})
			return err
		}))
		defer listener.Close()
		f.client, err = client.dial("tcp", target, patience(true))
		must(t, err)
		f.server, err = listener.Accept()
		must(t, err)
	}
	f.expect("at first", true)
	return f
}

// expect sends in both directions, and checks whether the messages arrive.
func (f *flow) expect(when string, want bool) {
	f.t.Helper()
	forth, back := make(chan bool), make(chan bool)
	go func() { forth <- passes(f.client, f.server, patience(want)) }()
	if want { // a UDP server may only answer
		if !<-forth {
			f.t.Errorf("%s: nothing passes forth", when)
		}
		forth = nil
	}
	go func() { back <- passes(f.server, f.client, patience(want)) }()
	if forth != nil && <-forth != want {
		f.t.Errorf("%s: passing forth is %t, want %t", when, !want, want)
	}
	if <-back != want {
		f.t.Errorf("%s: passing back is %t, want %t", when, !want, want)
	}
}

func passes(from, to net.Conn, wait time.Duration) bool {
	token := fmt.Sprintf("%08x", rand.Uint32())
	_, stream := from.(*net.TCPConn)
	got := make(chan bool)
	go func() {
		to.SetReadDeadline(time.Now().Add(wait))
		seen, buffer := "", make([]byte, 2048)
		for {
			n, err := to.Read(buffer)
			seen += string(buffer[:n])
			if len(seen) >= 8 && seen[len(seen)-8:] == token {
				got <- true
				return
			}
			if err != nil {
				got <- false
				return
			}
		}
	}()
	for try := range 3 {
		if try == 0 || !stream {
			io.WriteString(from, token)
		}
		select {
		case result := <-got:
			return result
		case <-time.After(wait / 3):
		}
	}
	return <-got
}

// changes are ways to forbid, and to allow again, that `active` speaks to `robot`.
var changes = map[string][2]func(*testing.T, *world){
	"egress rules": {
		func(t *testing.T, w *world) {
			w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {instance: active}}, policyTypes: [Egress]}`))
		},
		func(t *testing.T, w *world) { w.deletePolicy(t, policyOf(t, "p", `{}`)) },
	},
	"ingress rules": {
		func(t *testing.T, w *world) {
			w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: robot}}, policyTypes: [Ingress]}`))
		},
		func(t *testing.T, w *world) { w.deletePolicy(t, policyOf(t, "p", `{}`)) },
	},
	"a policy's selector": {
		func(t *testing.T, w *world) {
			w.setPolicy(t, policyOf(t, "closed", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress]}`))
			w.setPolicy(t, policyOf(t, "gate", `{podSelector: {matchLabels: {instance: standby}}, policyTypes: [Egress], egress: [{}]}`))
		},
		func(t *testing.T, w *world) {
			w.setPolicy(t, policyOf(t, "gate", `{podSelector: {matchLabels: {instance: active}}, policyTypes: [Egress], egress: [{}]}`))
		},
	},
	"a pod's label": {
		func(t *testing.T, w *world) {
			w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress], egress: [{to: [{podSelector: {matchLabels: {app: robot}}}]}]}`))
			pod := w.pod("robot")
			pod.Labels = map[string]string{"app": "other"}
			w.setPod(t, pod, 0)
		},
		func(t *testing.T, w *world) { w.setPod(t, w.pod("robot"), 0) },
	},
	"a namespace's label": {
		func(t *testing.T, w *world) {
			w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: robot}}, policyTypes: [Ingress], ingress: [{from: [{namespaceSelector: {matchLabels: {team: robots}}}]}]}`))
			w.setNamespaceLabel(t, "fleet", "team", "others")
		},
		func(t *testing.T, w *world) { w.setNamespaceLabel(t, "fleet", "team", "robots") },
	},
	"a rule's ports": {
		func(t *testing.T, w *world) {
			w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: robot}}, policyTypes: [Ingress], ingress: [{ports: [{port: 1}, {protocol: UDP, port: 1}]}]}`))
		},
		func(t *testing.T, w *world) {
			w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: robot}}, policyTypes: [Ingress], ingress: [{ports: [{port: 20000, endPort: 30000}, {protocol: UDP, port: 20000, endPort: 30000}]}]}`))
		},
	},
}

// TestEstablishedFlowsAreCut checks what enforcers that judge only new connections cannot do.
func TestEstablishedFlowsAreCut(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	for name, change := range changes {
		for _, protocol := range []string{"udp", "tcp"} {
			t.Run(name+" "+protocol, func(t *testing.T) {
				w.setPolicies(t, nil)
				flow := w.open(t, protocol, "active", "robot", netip.Addr{})
				change[0](t, w)
				flow.expect("after the deny", false)
				change[1](t, w)
				flow.expect("after it was allowed again", true)
			})
		}
	}
}

func (w *world) setNamespaceLabel(t testing.TB, name, key, value string) {
	t.Helper()
	for _, object := range w.table.NamespaceObjects() {
		if object.Name == name {
			object.Labels[key], object.ResourceVersion = value, w.version()
			from := len(w.nodes[1].seen())
			w.api.set(t, object)
			w.nodes[1].wait(t, from, caused("Namespace", object.ResourceVersion))
		}
	}
}
