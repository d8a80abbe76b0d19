// Package conformance holds the table of what a NetworkPolicy means, cases.yaml, and reads it.
package conformance

import (
	_ "embed"
	"encoding/json"
	"fmt"
	"regexp"
	"strconv"
	"strings"

	corev1 "k8s.io/api/core/v1"
	networkingv1 "k8s.io/api/networking/v1"
	metav1 "k8s.io/apimachinery/pkg/apis/meta/v1"
	"k8s.io/apimachinery/pkg/types"
	"sigs.k8s.io/yaml"
)

//go:embed cases.yaml
var source []byte

// Outside is the name of the host that is neither a pod nor a node.
const Outside = "outside"

// Table is the content of cases.yaml.
type Table struct {
	Namespaces map[string]map[string]string `json:"namespaces"`
	Pods       []Pod                        `json:"pods"`
	Cases      []Case                       `json:"cases"`
}

// Pod is a pod that exists in every case.
type Pod struct {
	Name      string            `json:"name"`
	Namespace string            `json:"namespace"`
	Node      int               `json:"node"`
	Labels    map[string]string `json:"labels"`
	Ports     []Port            `json:"ports"`
}

// Port is a named port.
type Port struct {
	Name     string          `json:"name"`
	Port     int32           `json:"port"`
	Protocol corev1.Protocol `json:"protocol"`
}

// Case is a list of policies, with the flows that they allow and deny.
type Case struct {
	Name     string            `json:"name"`
	Policies []json.RawMessage `json:"policies"`
	Allowed  []Flow            `json:"allowed"`
	Denied   []Flow            `json:"denied"`
}

// Flow is an attempt to reach a port of another pod.
type Flow struct {
	From, To string
	Protocol string // tcp, udp, sctp or icmp
	Port     uint16 // 0 for icmp
}

var flowText = regexp.MustCompile(`^(\S+) -> (\S+) (?:(icmp)|(tcp|udp|sctp)/(\d+))$`)

// UnmarshalJSON reads "FROM -> TO PROTOCOL/PORT".
func (f *Flow) UnmarshalJSON(data []byte) error {
	var text string
	if err := json.Unmarshal(data, &text); err != nil {
		return err
	}
	m := flowText.FindStringSubmatch(text)
	if m == nil {
		return fmt.Errorf("%q is not of the form \"FROM -> TO PROTOCOL/PORT\"", text)
	}
	f.From, f.To, f.Protocol = m[1], m[2], m[3]+m[4]
	if m[5] != "" {
		port, err := strconv.ParseUint(m[5], 10, 16)
		if err != nil {
			return fmt.Errorf("%q: %w", text, err)
		}
		f.Port = uint16(port)
	}
	return nil
}

func (f Flow) String() string {
	if f.Protocol == "icmp" {
		return fmt.Sprintf("%s -> %s icmp", f.From, f.To)
	}
	return fmt.Sprintf("%s -> %s %s/%d", f.From, f.To, f.Protocol, f.Port)
}

// Load reads the table.
func Load() (*Table, error) {
	var table Table
	if err := yaml.UnmarshalStrict(source, &table); err != nil {
		return nil, fmt.Errorf("cases.yaml: %w", err)
	}
	return &table, nil
}

// Objects returns the case's policies with the tokens replaced: address gives a pod's IPv4 address.
func (c Case) Objects(address func(pod string) string) ([]*networkingv1.NetworkPolicy, error) {
	var list []*networkingv1.NetworkPolicy
	for _, raw := range c.Policies {
		text := token.ReplaceAllStringFunc(string(raw), func(match string) string {
			name := strings.Trim(match, "${}")
			if pod, is := strings.CutPrefix(name, "address:"); is {
				return address(pod)
			}
			return name
		})
		object := &networkingv1.NetworkPolicy{}
		if err := yaml.UnmarshalStrict([]byte(text), object); err != nil {
			return nil, fmt.Errorf("%s: %w", c.Name, err)
		}
		list = append(list, object)
	}
	return list, nil
}

var token = regexp.MustCompile(`\$\{[a-z:-]+\}`)

// Object returns the pod as an object of the API.
func (p Pod) Object(node string, addresses ...string) *corev1.Pod {
	object := &corev1.Pod{
		ObjectMeta: metav1.ObjectMeta{Name: p.Name, Namespace: p.Namespace, Labels: p.Labels},
		Spec:       corev1.PodSpec{NodeName: node, Containers: []corev1.Container{{Name: "main"}}},
		Status:     corev1.PodStatus{Phase: corev1.PodRunning},
	}
	object.UID = types.UID("uid-of-" + p.Name)
	for _, port := range p.Ports {
		object.Spec.Containers[0].Ports = append(object.Spec.Containers[0].Ports,
			corev1.ContainerPort{Name: port.Name, ContainerPort: port.Port, Protocol: port.Protocol})
	}
	for _, address := range addresses {
		object.Status.PodIPs = append(object.Status.PodIPs, corev1.PodIP{IP: address})
	}
	if len(addresses) > 0 {
		object.Status.PodIP = addresses[0]
	}
	return object
}

// NamespaceObjects returns the namespaces as objects of the API.
func (t *Table) NamespaceObjects() []*corev1.Namespace {
	var list []*corev1.Namespace
	for name, labels := range t.Namespaces {
		object := &corev1.Namespace{ObjectMeta: metav1.ObjectMeta{Name: name, Labels: map[string]string{corev1.LabelMetadataName: name}}}
		for key, value := range labels {
			object.Labels[key] = value
		}
		list = append(list, object)
	}
	return list
}
