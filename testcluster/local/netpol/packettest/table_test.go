package packettest

import (
	"encoding/json"
	"slices"
	"strings"
	"sync"
	"testing"

	"understudy/testcluster/understudy-netpol/conformance"
)

// TestConformance compares the table with real packets.
func TestConformance(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	for _, c := range w.table.Cases {
		t.Run(c.Name, func(t *testing.T) {
			objects, err := c.Objects(w.address)
			must(t, err)
			w.setPolicies(t, objects)
			var wg sync.WaitGroup
			for family := range 2 {
				if family == 1 && slices.ContainsFunc(c.Policies, func(p json.RawMessage) bool { return strings.Contains(string(p), "ipBlock") }) {
					continue // blocks are of one family
				}
				for want, list := range map[bool][]conformance.Flow{true: c.Allowed, false: c.Denied} {
					wg.Add(1)
					go func() {
						defer wg.Done()
						w.try(t, list, family, want)
					}()
				}
			}
			wg.Wait()
		})
	}
}

func (w *world) expect(t *testing.T, flows []conformance.Flow, want bool) {
	t.Helper()
	w.try(t, flows, 0, want)
}

// try tries all flows at once.
func (w *world) try(t *testing.T, flows []conformance.Flow, family int, want bool) {
	t.Helper()
	var wg sync.WaitGroup
	for _, flow := range flows {
		if family == 1 && flow.Protocol == "sctp" {
			continue // its prober knows IPv4 only
		}
		wg.Add(1)
		go func() {
			defer wg.Done()
			got, err := w.reaches(flow, family, want)
			if err != nil {
				t.Errorf("%s: %v", flow, err)
			} else if got != want {
				t.Errorf("%s over IPv%d: allowed is %t, want %t", flow, 4+2*family, got, want)
			}
		}()
	}
	wg.Wait()
}
