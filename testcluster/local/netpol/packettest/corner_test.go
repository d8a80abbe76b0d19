package packettest

import (
	"errors"
	"fmt"
	"net/netip"
	"os"
	"path/filepath"
	"strings"
	"syscall"
	"testing"
	"time"

	corev1 "k8s.io/api/core/v1"

	"understudy/testcluster/understudy-netpol/conformance"
	"understudy/testcluster/understudy-netpol/internal/enforcer"
)

func flows(texts ...string) []conformance.Flow {
	list := make([]conformance.Flow, len(texts))
	for i, text := range texts {
		if err := list[i].UnmarshalJSON([]byte(fmt.Sprintf("%q", text))); err != nil {
			panic(err)
		}
	}
	return list
}

var service = netip.MustParseAddr("10.96.0.10")

// serve makes a service address as kube-proxy does: destination translation on each node, with another port, and a
// masquerade for a pod that reaches itself.
func (w *world) serve(t *testing.T, backend string) {
	t.Helper()
	for _, n := range w.nodes {
		n.run(t, fmt.Sprintf(`
			table ip test_services
			delete table ip test_services
			table ip test_services {
				chain prerouting {
					type nat hook prerouting priority dstnat
					ip daddr %[1]s udp dport 53 dnat to %[2]s:7950
					ip daddr %[1]s tcp dport 443 dnat to %[2]s:8080
					ip daddr %[1]s dnat to %[2]s
				}
				chain postrouting {
					type nat hook postrouting priority srcnat
					ip saddr %[2]s ip daddr %[2]s masquerade
				}
			}`, service, w.address(backend)), "nft", "-f", "-")
	}
}

func (w *world) reachesService(t *testing.T, from, to, protocol string, port uint16, want bool) bool {
	t.Helper()
	got, err := exchange(w.hosts[from], w.hosts[to].listeners, protocol, netip.AddrPortFrom(service, port), patience(want))
	must(t, err)
	return got
}

func TestServicesAreSeenAsTheirPods(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.serve(t, "robot")
	w.setPolicy(t, policyOf(t, "in", `{podSelector: {matchLabels: {app: robot}}, policyTypes: [Ingress], ingress: [{from: [{podSelector: {matchLabels: {instance: active}}}], ports: [{protocol: UDP, port: 7950}, {port: 8080}]}]}`))
	w.setPolicy(t, policyOf(t, "out", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress], egress: [{to: [{podSelector: {matchLabels: {app: robot}}}], ports: [{protocol: UDP, port: 7950}, {port: 8080}]}]}`))
	for _, try := range []struct {
		from, protocol string
		port           uint16
		want           bool
	}{
		{"active", "udp", 53, true}, {"active", "tcp", 443, true}, // the pod's ports count, not the service's
		{"active", "udp", 7949, false}, {"active", "tcp", 80, false},
		{"standby", "udp", 53, false}, {"camera", "udp", 53, false},
	} {
		if got := w.reachesService(t, try.from, "robot", try.protocol, try.port, try.want); got != try.want {
			t.Errorf("%s to the service %s/%d: allowed is %t, want %t", try.from, try.protocol, try.port, got, try.want)
		}
	}
}

func TestEstablishedFlowsThroughAServiceAreCut(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.serve(t, "robot")
	for _, protocol := range []string{"udp", "tcp"} {
		flow := w.open(t, protocol, "active", "robot", service)
		w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: robot}}, policyTypes: [Ingress], ingress: [{from: [{podSelector: {matchLabels: {instance: standby}}}]}]}`))
		flow.expect(protocol+" after the deny", false)
		w.setPolicies(t, nil)
	}
}

func TestAPodReachesItself(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.serve(t, "active")
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {}, policyTypes: [Ingress, Egress]}`))
	if !w.reachesService(t, "active", "active", "udp", 53, true) {
		t.Error("an isolated pod does not reach itself through a service")
	}
	if w.reachesService(t, "standby", "active", "udp", 53, false) {
		t.Error("another pod reaches it")
	}
}

func TestTheOwnNodeIsAlwaysAllowed(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {}, policyTypes: [Ingress, Egress]}`))
	for i, want := range []bool{true, false} {
		probe := &host{namespace: w.nodes[i].namespace}
		got, err := exchange(probe, w.hosts["active"].listeners, "tcp", netip.AddrPortFrom(w.hosts["active"].addrs[0], 80), patience(want))
		must(t, err)
		if got != want {
			t.Errorf("node %d to a pod of node 0: allowed is %t, want %t", i, got, want)
		}
	}
}

func TestErrorsOfAnAllowedFlowComeBack(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "out", `{podSelector: {}, policyTypes: [Ingress, Egress], egress: [{to: [{podSelector: {matchLabels: {app: robot}}}], ports: [{protocol: UDP}]}], ingress: [{from: [{podSelector: {matchLabels: {app: nav}}}], ports: [{protocol: UDP}]}]}`))
	refused := func(want bool) bool { // nobody listens on this port, so the robot's kernel answers with an ICMP error
		conn, err := w.hosts["active"].dial("udp", netip.AddrPortFrom(w.hosts["robot"].addrs[0], 12345), 0)
		must(t, err)
		defer conn.Close()
		for range 3 {
			conn.Write([]byte("anyone?"))
			conn.SetReadDeadline(time.Now().Add(patience(want) / 3))
			if _, err := conn.Read(make([]byte, 10)); errors.Is(err, syscall.ECONNREFUSED) {
				return true
			}
		}
		return false
	}
	if !refused(true) {
		t.Error("the ICMP error about an allowed flow does not come back")
	}
	w.setPolicy(t, policyOf(t, "out", `{podSelector: {}, policyTypes: [Ingress, Egress]}`))
	if refused(false) {
		t.Error("an ICMP error comes back although nothing is allowed")
	}
}

func TestFragmentsGoWithTheirDatagram(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: robot}}, policyTypes: [Ingress], ingress: [{ports: [{protocol: UDP, port: 7950}]}]}`))
	for port, want := range map[uint16]bool{7950: true, 7949: false} {
		conn, err := w.hosts["active"].dial("udp", netip.AddrPortFrom(w.hosts["robot"].addrs[0], port), 0)
		must(t, err)
		defer conn.Close()
		text := strings.Repeat("x", 1600) + fmt.Sprint(port) // more than a frame, less than the listeners' buffer
		got, err := request(conn, text, patience(want))
		must(t, err)
		if got != want {
			t.Errorf("a fragmented datagram to %d: passing is %t, want %t", port, got, want)
		}
	}
}

func TestWithoutAConnectionIsolatedPodsGetNothing(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	for _, n := range w.nodes {
		n.run(t, `table inet test_notrack { chain prerouting { type filter hook prerouting priority raw; notrack; }; }`, "nft", "-f", "-")
	}
	w.expect(t, flows("active -> robot udp/7950", "camera -> robot tcp/80"), true)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress], egress: [{}]}`))
	w.expect(t, flows("active -> robot udp/7950", "robot -> active udp/7950"), false)
	w.expect(t, flows("camera -> robot tcp/80"), true)
}

func TestAHostNetworkPodIsNeitherSelectedNorAPeer(t *testing.T) {
	w := newWorld(t)
	node := &corev1.Pod{Spec: corev1.PodSpec{NodeName: "node0", HostNetwork: true}, Status: corev1.PodStatus{Phase: corev1.PodRunning, PodIP: "192.0.2.11", PodIPs: []corev1.PodIP{{IP: "192.0.2.11"}}}}
	node.Namespace, node.Name, node.Labels = "fleet", "on-node0", map[string]string{"app": "agent"}
	w.api.set(t, node)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {}, policyTypes: [Ingress], ingress: [{from: [{podSelector: {matchLabels: {app: agent}}}]}]}`))
	probe := &host{namespace: w.nodes[0].namespace}
	got, err := exchange(probe, w.hosts["robot"].listeners, "tcp", netip.AddrPortFrom(w.hosts["robot"].addrs[0], 80), patience(false))
	must(t, err)
	if got {
		t.Error("a node's address counts as a pod's because of a pod on the host's network")
	}
	if elements := w.nodes[0].run(t, "", "nft", "list", "set", "inet", "understudy_netpol", "local4"); strings.Contains(elements, "192.0.2.11") {
		t.Error("the node's address is among the pods' addresses")
	}
}

func TestAnEndedPodsAddressMayBeUsedAgain(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress]}`))
	w.expect(t, flows("active -> robot udp/7950"), false)
	ended := w.pod("active")
	ended.Status.Phase = corev1.PodFailed
	w.setPod(t, ended, 0)
	w.expect(t, flows("active -> robot udp/7950"), false) // nobody's address now, and not open for that
	next := w.pod("active")
	next.Name, next.UID, next.Labels = "next", "uid-of-next", map[string]string{"app": "other"}
	w.setPod(t, next, 0)
	w.expect(t, flows("active -> robot udp/7950"), true)
}

// TestADeletedPodStaysCutOff is about deletion by force: the object is gone at once, the processes are not.
func TestADeletedPodStaysCutOff(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress]}`))
	flow := w.open(t, "udp", "camera", "robot", netip.Addr{})
	for _, name := range []string{"active", "camera"} {
		from := len(w.nodes[0].seen())
		w.api.remove(t, w.pod(name))
		w.nodes[0].wait(t, from, func(c enforcer.Commit) bool { return c.Causes[0].Name == name })
	}
	w.expect(t, flows("active -> robot udp/7950", "robot -> active udp/7950", "camera -> robot udp/7950"), false)
	flow.expect("after the pod was deleted", false)
}

// TestANewPodIsKnownByItsNetwork shows that a pod is policed, and not cut off, before its status says its address.
func TestANewPodIsKnownByItsNetwork(t *testing.T) {
	w := newWorld(t)
	h := w.addHost(t, t.TempDir(), "fresh", 0, 99)
	h.listeners = listen(t, h.namespace)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "p", `{podSelector: {matchLabels: {app: nav}}, policyTypes: [Egress], egress: [{ports: [{protocol: UDP, port: 1000}]}]}`))
	pod := w.pod("active")
	pod.Name, pod.UID, pod.Status = "fresh", "uid-of-fresh", corev1.PodStatus{Phase: corev1.PodPending}
	w.api.set(t, pod)
	w.expect(t, flows("fresh -> robot udp/1000", "robot -> fresh udp/1000"), false) // unknown
	w.writeSandbox(t, h, "pods-other", "uid-of-an-earlier-one")
	time.Sleep(50 * time.Millisecond)
	w.expect(t, flows("fresh -> robot udp/1000"), false)
	from := len(w.nodes[0].seen())
	w.writeSandbox(t, h, "pods-c", "uid-of-fresh")
	commit := w.nodes[0].wait(t, from, func(c enforcer.Commit) bool { return c.Causes[0].Kind == "Sandbox" })
	t.Logf("known %v after the CNI's result was written", commit.Latency())
	w.expect(t, flows("fresh -> robot udp/1000", "robot -> fresh udp/1000"), true)
	w.expect(t, flows("fresh -> robot udp/7950"), false)
	must(t, os.Remove(filepath.Join(w.nodes[0].results, "pods-c")))
	w.nodes[0].wait(t, from, func(c enforcer.Commit) bool { return c.Causes[0].Event == "delete" })
	w.expect(t, flows("fresh -> robot udp/1000"), false)
}

// writeSandbox writes the CNI's result for a pod of node 0.
func (w *world) writeSandbox(t *testing.T, h *host, file, uid string) {
	t.Helper()
	text := fmt.Sprintf(`{"kind":"cniCacheV1","containerId":"c","ifName":"eth0","networkName":"pods",
		"cniArgs":[["IgnoreUnknown","1"],["K8S_POD_NAMESPACE","fleet"],["K8S_POD_NAME","%s"],["K8S_POD_UID","%s"]],
		"result":{"cniVersion":"1.0.0","ips":[{"address":"%s/24","gateway":"10.199.1.1"}]}}`, h.name, uid, h.addrs[0])
	must(t, os.WriteFile(filepath.Join(w.nodes[0].results, file), []byte(text), 0o600))
}

func TestIPv4AndIPv6AreJudgedAlike(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	w.setPolicy(t, policyOf(t, "block", fmt.Sprintf(`{podSelector: {matchLabels: {app: camera}}, policyTypes: [Egress], egress: [{to: [{ipBlock: {cidr: "%s/64", except: ["%s/128"]}}]}]}`,
		w.hosts["robot"].addrs[1], w.hosts["dashboard"].addrs[1])))
	for _, try := range []struct {
		flow string
		want bool
	}{{"camera -> robot udp/1000", true}, {"camera -> dashboard udp/1000", false}, {"camera -> standby udp/1000", false}} {
		got, err := w.reaches(flows(try.flow)[0], 1, try.want)
		must(t, err)
		if got != try.want {
			t.Errorf("%s over IPv6: allowed is %t, want %t", try.flow, got, try.want)
		}
	}
	w.expect(t, flows("camera -> robot udp/1000"), false) // the block is of the other family
}
