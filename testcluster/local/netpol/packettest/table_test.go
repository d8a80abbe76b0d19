package packettest

import (
	"sync"
	"testing"

	"understudy/testcluster/understudy-netpol/conformance"
)

// TestConformance holds the table against packets.
func TestConformance(t *testing.T) {
	w := newWorld(t)
	w.enforce(t)
	for _, c := range w.table.Cases {
		t.Run(c.Name, func(t *testing.T) {
			objects, err := c.Objects(w.address)
			must(t, err)
			w.setPolicies(t, objects)
			w.expect(t, c.Allowed, true)
			w.expect(t, c.Denied, false)
		})
	}
}

// expect tries all flows at once.
func (w *world) expect(t *testing.T, flows []conformance.Flow, want bool) {
	t.Helper()
	var wg sync.WaitGroup
	for _, flow := range flows {
		wg.Add(1)
		go func() {
			defer wg.Done()
			got, err := w.reaches(flow, 0)
			if err != nil {
				t.Errorf("%s: %v", flow, err)
			} else if got != want {
				t.Errorf("%s: allowed is %t, want %t", flow, got, want)
			}
		}()
	}
	wg.Wait()
}
