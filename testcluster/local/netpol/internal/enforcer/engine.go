package enforcer

import (
	"context"
	"errors"
	"fmt"
	"log/slog"
	"os"
	"slices"
	"time"

	corev1 "k8s.io/api/core/v1"
	networkingv1 "k8s.io/api/networking/v1"

	"understudy/testcluster/understudy-netpol/internal/nft"
	"understudy/testcluster/understudy-netpol/internal/policy"
	"understudy/testcluster/understudy-netpol/internal/ruleset"
)

// Options of an Engine.
type Options struct {
	Node          string
	PodInterfaces string        // prefix of the names of the host ends of pods' interfaces; see ruleset.NewRenderer
	CNIResults    string        // libcni's directory of results; empty: addresses come from status.podIPs alone
	Reconcile     time.Duration // how often the kernel's table is compared with what it should be
	Modes         string        // the file that Modes are read from; empty: none are
	Netns         *os.File      // nil: the process' own
}

// Engine applies the changes from the sources to the kernel, in one goroutine.
type Engine struct {
	options Options
	queue   *queue
	sources []*source
	index   *policy.Index
	render  *ruleset.Renderer
	conn    *nft.Conn
	applied *nft.Ruleset // what the kernel holds; nil when that is not known
	report  *Report

	failed  bool     // the last transaction was refused
	listed  int      // kinds whose objects have all been taken
	pending []change // what is not yet in the kernel

	modeFile modeFile
	modes    Modes
	relabels []change         // in the order of their receipt
	waiting  <-chan time.Time // until the first change is due that a mode holds back
}

// New makes an engine; it does nothing before Run.
func New(options Options, report *Report) *Engine {
	q := newQueue()
	return &Engine{
		options: options,
		queue:   q,
		sources: []*source{podSource(q), namespaceSource(q), policySource(q)},
		index:   policy.NewIndex(options.Node),
		render:  ruleset.NewRenderer(options.PodInterfaces),
		report:  report,

		modeFile: modeFile{path: options.Modes},
	}
}

// Cleanup removes the table from the network namespace.
func Cleanup(netns *os.File) error {
	conn, err := nft.Open(netns)
	if err != nil {
		return err
	}
	defer conn.Close()
	return conn.Commit(nft.Remove(ruleset.Table))
}

// Run enforces until the context ends. The rules stay when it returns. Run changes nothing until all objects have been
// listed once: rules of an earlier enforcer stay until then, and on a node without an earlier enforcer pods are open.
func (g *Engine) Run(ctx context.Context, api API) error {
	conn, err := nft.Open(g.options.Netns)
	if err != nil {
		return err
	}
	defer conn.Close()
	g.conn = conn
	orders := make(chan []byte)
	if g.options.Modes != "" {
		// Before the first change, which a deaf enforcer must not apply.
		if text, there := g.modeFile.read(); there {
			if err := g.obey(text); err != nil {
				return err
			}
		}
		go g.modeFile.follow(ctx, orders)
	}
	if g.options.CNIResults != "" {
		watch := &sandboxes{g.options.CNIResults, g.queue}
		if err := watch.start(ctx); err != nil {
			return err
		}
	}
	go g.sources[0].run(ctx, api.Pods, &corev1.Pod{})
	go g.sources[1].run(ctx, api.Namespaces, &corev1.Namespace{})
	go g.sources[2].run(ctx, api.NetworkPolicies, &networkingv1.NetworkPolicy{})

	reconcile := time.NewTicker(g.options.Reconcile)
	defer reconcile.Stop()
	const lastRetry = 5 * time.Second
	retryIn := time.Duration(0) // at once, then with longer and longer pauses
	var retry <-chan time.Time
	for {
		var err error
		select {
		case <-ctx.Done():
			return nil
		case <-g.queue.ready:
			g.absorb()
			if retry != nil || !g.synced() {
				continue // the retry includes these changes
			}
			err = g.apply()
		case <-g.waiting:
			g.absorb()
			if retry != nil || !g.synced() {
				continue
			}
			err = g.apply()
		case text := <-orders:
			err = g.obey(text)
		case <-retry:
			g.absorb()
			err = g.apply()
		case <-reconcile.C:
			if g.applied == nil || !g.synced() {
				continue
			}
			err = g.compare()
		}
		retry = nil
		if err == nil {
			retryIn = 0
			continue
		}
		// A full replacement is correct whatever the kernel holds now.
		g.applied, g.failed = nil, true
		g.report.failure(err)
		slog.Error("transaction failed, replacing the whole table next", "error", err.Error(), "retryIn", retryIn.String())
		retry, retryIn = time.After(retryIn), min(2*retryIn+50*time.Millisecond, lastRetry)
	}
}

// synced reports whether all objects have been listed once, and all of them are in the index: rules made from a part of them
// could open what is closed.
func (g *Engine) synced() bool { return g.listed == len(g.sources) }

// absorb applies the waiting changes to the index, as far as the modes let it.
func (g *Engine) absorb() {
	g.waiting = nil
	if g.modes.Deaf {
		return
	}
	now := time.Now()
	list, held := g.queue.take(now.Add(-g.modes.lag()))
	g.absorbAll(list)
	due := g.relabelDue(now)
	if !held.IsZero() && (due.IsZero() || held.Add(g.modes.lag()).Before(due)) {
		due = held.Add(g.modes.lag())
	}
	if !due.IsZero() {
		g.waiting = time.After(time.Until(due))
	}
}

func (g *Engine) absorbAll(list []change) {
	for _, change := range list {
		if change.cause.Event == synced {
			g.listed++
		}
		var matters bool
		var problems []error
		switch {
		case change.pod != nil:
			matters = g.setPod(change)
		case change.apply == nil:
			matters = g.setNamespace(change)
		default:
			matters, problems = change.apply(g.index)
		}
		for _, problem := range problems {
			slog.Error(problem.Error())
		}
		// A written policy is reported even if it does not change the model: somebody may wait until its resource version
		// is enforced.
		if matters || (change.cause.Kind == "NetworkPolicy" && change.cause.Event != "list") {
			g.pending = append(g.pending, change)
		}
	}
}

// apply makes the kernel's table match the model, in one transaction.
func (g *Engine) apply() error {
	if len(g.pending) == 0 && !g.failed {
		return nil
	}
	started := time.Now()
	want := g.render.Render(g.index.Model())
	have := g.applied
	if have == nil && !g.failed {
		// The table of an earlier run is adapted. If there is none, or it cannot be read, the whole table is written.
		have, _ = g.conn.Dump(ruleset.Table)
	}
	batch := nft.Update(ruleset.Table, have, want)
	built := time.Now()
	if err := g.conn.Commit(batch); err != nil {
		return err
	}
	committed := time.Now()
	g.applied, g.failed = want, false
	if !batch.Empty() || slices.ContainsFunc(g.pending, func(c change) bool { return c.cause.Kind == "NetworkPolicy" }) {
		g.report.commit(newCommit(g.pending, batch.Changes, started, built, committed))
	}
	g.pending = nil
	return nil
}

// compare reads the table back, and repairs it if someone else has changed it.
func (g *Engine) compare() error {
	found, err := g.conn.Dump(ruleset.Table)
	if errors.Is(err, nft.ErrChanging) {
		slog.Info("rules changed while they were compared; next time")
		return nil
	}
	if err != nil {
		return fmt.Errorf("comparing the table: %w", err)
	}
	g.report.compared()
	difference := nft.Update(ruleset.Table, found, g.applied)
	if difference.Empty() {
		return nil
	}
	slog.Warn("the table is not what it should be, repairing it", "difference", difference.Changes)
	g.pending = append(g.pending, change{cause: Cause{Kind: "Table", Name: ruleset.Table, Event: "repair"}, received: time.Now()})
	g.applied = found
	return g.apply()
}
