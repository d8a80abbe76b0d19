package policy_test

import (
	"fmt"
	"net/netip"
	"testing"

	"k8s.io/apimachinery/pkg/labels"

	"understudy/testcluster/understudy-netpol/conformance"
	"understudy/testcluster/understudy-netpol/internal/policy"
)

var protocols = map[string]policy.Protocol{"icmp": 1, "tcp": policy.TCP, "udp": policy.UDP, "sctp": policy.SCTP}

// TestConformance compares the table with the pure model; the nodes of source and destination each decide their part.
func TestConformance(t *testing.T) {
	table, err := conformance.Load()
	if err != nil {
		t.Fatal(err)
	}
	addresses := map[string]string{conformance.Outside: "192.0.2.20"}
	for i, pod := range table.Pods {
		addresses[pod.Name] = fmt.Sprintf("10.199.%d.%d", pod.Node+1, i+2)
	}
	for _, c := range table.Cases {
		t.Run(c.Name, func(t *testing.T) {
			objects, err := c.Objects(func(pod string) string { return addresses[pod] })
			if err != nil {
				t.Fatal(err)
			}
			var models []*policy.Model
			for node := range 2 {
				index := policy.NewIndex(fmt.Sprint("node", node))
				for _, namespace := range table.NamespaceObjects() {
					index.SetNamespace(namespace.Name, labels.Set(namespace.Labels))
				}
				for _, pod := range table.Pods {
					index.SetPod(policy.FromPod(pod.Object(fmt.Sprint("node", pod.Node), addresses[pod.Name])))
				}
				for _, object := range objects {
					if _, problems := index.SetPolicy(object); len(problems) > 0 {
						t.Error(problems)
					}
				}
				models = append(models, index.Model())
			}
			judge := func(flows []conformance.Flow, want bool) {
				for _, f := range flows {
					flow := policy.Flow{
						From: netip.MustParseAddr(addresses[f.From]), To: netip.MustParseAddr(addresses[f.To]),
						Protocol: protocols[f.Protocol], Port: f.Port,
					}
					got := true
					for _, model := range models {
						got = got && model.Leaves(flow) && model.Arrives(flow)
					}
					if got != want {
						t.Errorf("%s: allowed is %t, want %t", f, got, want)
					}
				}
			}
			judge(c.Allowed, true)
			judge(c.Denied, false)
		})
	}
}
