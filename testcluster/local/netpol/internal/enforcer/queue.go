// Package enforcer keeps a node's nftables table in step with the cluster.
package enforcer

import (
	"sync"
	"time"

	"k8s.io/apimachinery/pkg/labels"

	"understudy/testcluster/understudy-netpol/internal/policy"
)

// Cause is an object whose change led to a transaction.
type Cause struct {
	Kind            string `json:"kind"`
	Namespace       string `json:"namespace,omitempty"`
	Name            string `json:"name"`
	ResourceVersion string `json:"resourceVersion,omitempty"`
	Event           string `json:"event"` // set, delete, list, synced or repair
}

// synced is the event after a kind's first list.
const synced = "synced"

// change is an event with its effect on the index. apply reports whether it has an effect. A pod or the
// labels of a namespace that came or changed are there themselves instead.
type change struct {
	cause    Cause
	received time.Time
	apply    func(*policy.Index) (bool, []error)
	pod      *policy.Pod
	labels   labels.Set
}

// queue passes changes on in order. take returns all waiting changes that were received by then, so a burst becomes one
// transaction, and a single change does not wait for others. It also returns when the first of those that stay was received.
type queue struct {
	mu      sync.Mutex
	waiting []change
	ready   chan struct{}
}

func newQueue() *queue { return &queue{ready: make(chan struct{}, 1)} }

func (q *queue) put(c change) {
	q.mu.Lock()
	q.waiting = append(q.waiting, c)
	q.mu.Unlock()
	select {
	case q.ready <- struct{}{}:
	default: // the taker is already notified
	}
}

func (q *queue) take(until time.Time) (list []change, next time.Time) {
	q.mu.Lock()
	defer q.mu.Unlock()
	for i, c := range q.waiting {
		if c.received.After(until) {
			list, q.waiting = q.waiting[:i:i], q.waiting[i:]
			return list, c.received
		}
	}
	list, q.waiting = q.waiting, nil
	return list, time.Time{}
}
