// Package policy turns Pods, Namespaces and NetworkPolicies into a model of what one node has to enforce. It does no
// input or output.
//
// Semantics are those of networking.k8s.io/v1 (KEP-2079 for endPort). Decisions the specification leaves open, or that
// matter here:
//   - a pod that has ended (Succeeded, Failed) has no addresses; its address may already belong to another pod;
//   - a pod that is being deleted is still selected, and still a peer, until its object is gone;
//   - pods on the host's network are neither selected nor peers: their address is the node's;
//   - a pod can always reach itself;
//   - the present policies also judge established connections: the model does not know which connections exist.
package policy

import (
	"maps"
	"net/netip"
	"slices"
	"strings"
	"time"

	corev1 "k8s.io/api/core/v1"
	"k8s.io/apimachinery/pkg/labels"
)

// Key names a namespaced object.
type Key struct{ Namespace, Name string }

func (k Key) String() string { return k.Namespace + "/" + k.Name }

func compareKeys(a, b Key) int {
	if c := strings.Compare(a.Namespace, b.Namespace); c != 0 {
		return c
	}
	return strings.Compare(a.Name, b.Name)
}

// Pod has the fields of a Pod that matter here.
type Pod struct {
	Key
	UID         string
	Node        string
	Labels      labels.Set
	Reported    []netip.Addr // status.podIPs
	HostNetwork bool
	Ended       bool
	Created     time.Time
	Ports       []ContainerPort
}

// ContainerPort is a named port of a pod.
type ContainerPort struct {
	PortName
	Number uint16
}

// PortName is how a policy refers to a port by name.
type PortName struct {
	Protocol Protocol
	Name     string
}

// Protocol is an IP protocol number.
type Protocol uint8

const (
	TCP  Protocol = 6
	UDP  Protocol = 17
	SCTP Protocol = 132
)

func protocol(p *corev1.Protocol) (Protocol, bool) {
	if p == nil {
		return TCP, true
	}
	switch *p {
	case corev1.ProtocolTCP, "":
		return TCP, true
	case corev1.ProtocolUDP:
		return UDP, true
	case corev1.ProtocolSCTP:
		return SCTP, true
	}
	return 0, false
}

func (p Protocol) String() string {
	switch p {
	case TCP:
		return "tcp"
	case UDP:
		return "udp"
	}
	return "sctp"
}

// FromPod takes from a Pod what matters.
func FromPod(object *corev1.Pod) *Pod {
	pod := &Pod{
		Key:         Key{object.Namespace, object.Name},
		UID:         string(object.UID),
		Node:        object.Spec.NodeName,
		Labels:      labels.Set(object.Labels),
		HostNetwork: object.Spec.HostNetwork,
		Ended:       object.Status.Phase == corev1.PodSucceeded || object.Status.Phase == corev1.PodFailed,
		Created:     object.CreationTimestamp.Time,
	}
	pod.Reported = addresses(object.Status)
	for _, container := range object.Spec.Containers {
		pod.Ports = append(pod.Ports, namedPorts(container)...)
	}
	for _, container := range object.Spec.InitContainers {
		// Only a sidecar lives as long as the pod; ports of other init containers would open what nobody serves.
		if container.RestartPolicy != nil && *container.RestartPolicy == corev1.ContainerRestartPolicyAlways {
			pod.Ports = append(pod.Ports, namedPorts(container)...)
		}
	}
	return pod
}

func addresses(status corev1.PodStatus) []netip.Addr {
	texts := []string{status.PodIP}
	for _, ip := range status.PodIPs {
		texts = append(texts, ip.IP)
	}
	var list []netip.Addr
	for _, text := range texts {
		if addr, err := netip.ParseAddr(text); err == nil && !slices.Contains(list, addr.Unmap()) {
			list = append(list, addr.Unmap())
		}
	}
	return list
}

func namedPorts(container corev1.Container) []ContainerPort {
	var list []ContainerPort
	for _, port := range container.Ports {
		if proto, known := protocol(&port.Protocol); known && port.Name != "" && port.ContainerPort > 0 && port.ContainerPort < 1<<16 {
			list = append(list, ContainerPort{PortName{proto, port.Name}, uint16(port.ContainerPort)})
		}
	}
	return list
}

// same reports whether nothing that matters has changed; a Pod's status is written far more often than that.
func (p *Pod) same(other *Pod) bool {
	return p.UID == other.UID && p.Node == other.Node && p.HostNetwork == other.HostNetwork && p.Ended == other.Ended &&
		p.Created.Equal(other.Created) && labels.Equals(p.Labels, other.Labels) &&
		slices.Equal(p.Reported, other.Reported) && slices.Equal(p.Ports, other.Ports)
}

// SameIdentity reports whether both have the same labels, without those that Cilium ignores by default.
func (p *Pod) SameIdentity(other *Pod) bool {
	return labels.Equals(identity(p.Labels), identity(other.Labels))
}

func identity(set labels.Set) labels.Set {
	counted := maps.Clone(set)
	maps.DeleteFunc(counted, func(key, _ string) bool { return strings.HasPrefix(key, "annotation") })
	return counted
}

// WithLabelsOf returns the pod with the labels of another one.
func (p *Pod) WithLabelsOf(other *Pod) *Pod {
	relabelled := *p
	relabelled.Labels = other.Labels
	return &relabelled
}

// Sandbox is an address the node's CNI has given to a pod. It is known before the pod's first container starts, about a
// second earlier than status.podIPs, and for as long as the network exists, also when the Pod object is long gone.
type Sandbox struct {
	Pod     Key
	UID     string // empty when the runtime does not say
	Addrs   []netip.Addr
	Created time.Time
}
