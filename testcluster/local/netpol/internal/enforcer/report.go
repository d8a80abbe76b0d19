package enforcer

import (
	"fmt"
	"io"
	"log/slog"
	"net/http"
	"slices"
	"strings"
	"sync"
	"time"

	"understudy/testcluster/understudy-netpol/internal/nft"
	"understudy/testcluster/understudy-netpol/internal/policy"
)

// Commit describes one transaction.
type Commit struct {
	Causes    []Cause
	Changes   nft.Changes
	Received  time.Time // when the first of the causes was received
	Started   time.Time // when work on it began; before that it waited for an earlier transaction
	Built     time.Time // when the transaction was sent to the kernel
	Committed time.Time // when the kernel had confirmed it: every later packet obeys
}

// Latency is the time from the receipt of the first cause to the kernel's confirmation.
func (c Commit) Latency() time.Duration { return c.Committed.Sub(c.Received) }

func newCommit(pending []change, changes nft.Changes, started, built, committed time.Time) Commit {
	c := Commit{Changes: changes, Received: started, Started: started, Built: built, Committed: committed}
	for _, change := range pending {
		c.Causes = append(c.Causes, change.cause)
		if change.received.Before(c.Received) {
			c.Received = change.received
		}
	}
	return c
}

func (c Commit) kinds() []string {
	var kinds []string
	for _, cause := range c.Causes {
		if !slices.Contains(kinds, cause.Kind) {
			kinds = append(kinds, cause.Kind)
		}
	}
	slices.Sort(kinds)
	return kinds
}

// Report keeps the log and the metrics.
type Report struct {
	// Observe, when set, is called with every commit, before anything else happens.
	Observe func(Commit)

	mu           sync.Mutex
	transactions map[string]int // by kinds of causes
	failures     int
	comparisons  int
	repairs      int
	latency      histogram
	kernel       histogram
	last         time.Time
	policies     map[policy.Key]enforced
}

type enforced struct {
	version string
	at      time.Time
}

// NewReport returns an empty report.
func NewReport() *Report {
	return &Report{transactions: map[string]int{}, policies: map[policy.Key]enforced{}}
}

const causesInLog = 20 // for a burst the log names only the first causes

func (r *Report) commit(c Commit) {
	if r.Observe != nil {
		r.Observe(c)
	}
	kinds := c.kinds()
	r.mu.Lock()
	r.transactions[strings.Join(kinds, ",")]++
	r.latency.observe(c.Latency())
	r.kernel.observe(c.Committed.Sub(c.Built))
	r.last = c.Committed
	for _, cause := range c.Causes {
		switch {
		case cause.Kind == "Table":
			r.repairs++
		case cause.Kind != "NetworkPolicy" || cause.Name == "":
		case cause.Event == "delete":
			delete(r.policies, policy.Key{Namespace: cause.Namespace, Name: cause.Name})
		default:
			r.policies[policy.Key{Namespace: cause.Namespace, Name: cause.Name}] = enforced{cause.ResourceVersion, c.Committed}
		}
	}
	r.mu.Unlock()
	slog.Info("commit", "kinds", kinds, "causes", c.Causes[:min(len(c.Causes), causesInLog)], "causesTotal", len(c.Causes),
		"receivedUnixNano", c.Received.UnixNano(), "commitUnixNano", c.Committed.UnixNano(),
		"latencyMicros", c.Latency().Microseconds(), "waitMicros", c.Started.Sub(c.Received).Microseconds(),
		"buildMicros", c.Built.Sub(c.Started).Microseconds(), "kernelMicros", c.Committed.Sub(c.Built).Microseconds(),
		"changes", c.Changes)
}

func (r *Report) failure(error) {
	r.mu.Lock()
	defer r.mu.Unlock()
	r.failures++
}

func (r *Report) compared() {
	r.mu.Lock()
	defer r.mu.Unlock()
	r.comparisons++
}

// bounds of the histograms' buckets, in seconds.
var bounds = [...]float64{.0001, .00025, .0005, .001, .002, .003, .005, .01, .025, .05, .1, .5, 2.5}

type histogram struct {
	counts [len(bounds)]int
	total  int
	sum    float64
}

func (h *histogram) observe(d time.Duration) {
	for i, bound := range bounds {
		if d.Seconds() <= bound {
			h.counts[i]++
		}
	}
	h.total++
	h.sum += d.Seconds()
}

func (h *histogram) write(w io.Writer, name, help string) {
	fmt.Fprintf(w, "# HELP %s %s\n# TYPE %s histogram\n", name, help, name)
	for i, bound := range bounds {
		fmt.Fprintf(w, "%s_bucket{le=\"%g\"} %d\n", name, bound, h.counts[i])
	}
	fmt.Fprintf(w, "%s_bucket{le=\"+Inf\"} %d\n%s_sum %g\n%s_count %d\n", name, h.total, name, h.sum, name, h.total)
}

// ServeHTTP answers with the metrics in Prometheus' text format.
func (r *Report) ServeHTTP(w http.ResponseWriter, _ *http.Request) {
	w.Header().Set("Content-Type", "text/plain; version=0.0.4")
	r.mu.Lock()
	defer r.mu.Unlock()
	metric := func(name, kind, help string) {
		fmt.Fprintf(w, "# HELP understudy_netpol_%s %s\n# TYPE understudy_netpol_%s %s\n", name, help, name, kind)
	}
	metric("transactions_total", "counter", "Changes brought to the kernel, by the kinds of objects that caused them.")
	for kinds, n := range r.transactions {
		fmt.Fprintf(w, "understudy_netpol_transactions_total{kinds=%q} %d\n", kinds, n)
	}
	metric("failures_total", "counter", "Transactions the kernel refused; each is followed by a full replacement.")
	fmt.Fprintf(w, "understudy_netpol_failures_total %d\n", r.failures)
	metric("comparisons_total", "counter", "Times the kernel's table was read back and compared.")
	fmt.Fprintf(w, "understudy_netpol_comparisons_total %d\n", r.comparisons)
	metric("repairs_total", "counter", "Times it was not what it should have been, and was replaced.")
	fmt.Fprintf(w, "understudy_netpol_repairs_total %d\n", r.repairs)
	metric("last_commit_timestamp_nanoseconds", "gauge", "Wall clock at the last confirmed transaction, nanoseconds since 1970; 0 before the first.")
	last := int64(0)
	if !r.last.IsZero() {
		last = r.last.UnixNano()
	}
	fmt.Fprintf(w, "understudy_netpol_last_commit_timestamp_nanoseconds %d\n", last)
	metric("policy_commit_timestamp_nanoseconds", "gauge", "Wall clock when this version of a policy was in force, nanoseconds since 1970.")
	for key, is := range r.policies {
		fmt.Fprintf(w, "understudy_netpol_policy_commit_timestamp_nanoseconds{namespace=%q,name=%q,resource_version=%q} %d\n",
			key.Namespace, key.Name, is.version, is.at.UnixNano())
	}
	r.latency.write(w, "understudy_netpol_latency_seconds", "From the receipt of a change to the kernel's confirmation.")
	r.kernel.write(w, "understudy_netpol_kernel_seconds", "The kernel's part of it.")
}

// Ready answers 200 once the rules are in force for the first time.
func (r *Report) Ready(w http.ResponseWriter, _ *http.Request) {
	r.mu.Lock()
	defer r.mu.Unlock()
	if r.last.IsZero() {
		http.Error(w, "the objects have not been listed yet", http.StatusServiceUnavailable)
		return
	}
	fmt.Fprintln(w, "ok")
}
