package enforcer

import (
	"bytes"
	"context"
	"encoding/json"
	"errors"
	"fmt"
	"io"
	"io/fs"
	"log/slog"
	"os"
	"slices"
	"time"

	"k8s.io/apimachinery/pkg/labels"

	"understudy/testcluster/understudy-netpol/internal/policy"
)

// Modes are weaknesses that networks of real clusters have. A test switches them on for one node while it runs.
type Modes struct {
	// Established lets a flow live on of which a packet was let through before, whatever the policies say now.
	Established bool `json:"established"`
	// Deaf applies no changes of the cluster. They wait, and are applied when the mode ends.
	Deaf bool `json:"deaf"`
	// LagMilliseconds applies each change that much later.
	LagMilliseconds uint `json:"lagMilliseconds"`
	// KeepVanished leaves a pod of this node what it was allowed last when its object is deleted before its network.
	KeepVanished bool `json:"keepVanished"`
	// LabelLagSeconds applies a change of the labels of a pod or of its namespace that much later. Until then, no change of a policy
	// is applied to the pod. Labels of a pod whose keys begin with "annotation" are applied at once. Cilium does the same.
	LabelLagSeconds float64 `json:"labelLagSeconds"`
}

func (m Modes) lag() time.Duration { return time.Duration(m.LagMilliseconds) * time.Millisecond }

func (m Modes) labelLag() time.Duration {
	return time.Duration(m.LabelLagSeconds * float64(time.Second))
}

// parseModes refuses what it does not know: a misspelt mode would be a test that tests nothing.
func parseModes(text []byte) (modes Modes, err error) {
	if len(bytes.TrimSpace(text)) == 0 {
		return modes, nil
	}
	decoder := json.NewDecoder(bytes.NewReader(text))
	decoder.DisallowUnknownFields()
	if err := decoder.Decode(&modes); err != nil {
		return Modes{}, fmt.Errorf("modes: %w", err)
	}
	if _, err := decoder.Token(); !errors.Is(err, io.EOF) {
		return Modes{}, errors.New("modes: one JSON object is needed, and nothing after it")
	}
	if modes.LabelLagSeconds < 0 {
		return Modes{}, fmt.Errorf("modes: labelLagSeconds is %g, which is negative", modes.LabelLagSeconds)
	}
	return modes, nil
}

// modeFile is where the modes come from, and where the answer goes: a file beside it with the suffix .applied.
type modeFile struct {
	path string
	last fs.FileInfo
}

// Applied is the answer: the text that was read, and why it was refused.
type Applied struct {
	Text  string `json:"text"`
	Error string `json:"error"`
}

const modesEvery = 20 * time.Millisecond

// read returns the file's text, and false if it is the file that was read before. Without a file the text is empty.
func (f *modeFile) read() ([]byte, bool) {
	info, err := os.Stat(f.path)
	if err != nil {
		changed := f.last != nil
		f.last = nil
		return nil, changed
	}
	if f.last != nil && os.SameFile(f.last, info) && f.last.ModTime().Equal(info.ModTime()) {
		return nil, false
	}
	text, err := os.ReadFile(f.path)
	if err != nil {
		return nil, false // it is gone again; the next look says so
	}
	f.last = info
	return text, true
}

// follow sends the text of each new version of the file.
func (f *modeFile) follow(ctx context.Context, to chan<- []byte) {
	for ctx.Err() == nil {
		sleep(ctx, modesEvery)
		if text, changed := f.read(); changed {
			select {
			case to <- text:
			case <-ctx.Done():
			}
		}
	}
}

func (f *modeFile) answer(text []byte, refused error) {
	applied := Applied{Text: string(text)}
	if refused != nil {
		applied.Error = refused.Error()
	}
	data, err := json.Marshal(applied)
	if err == nil {
		partial := f.path + ".partial"
		if err = os.WriteFile(partial, data, 0o644); err == nil {
			err = os.Rename(partial, f.path+".applied")
		}
	}
	if err != nil {
		slog.Error("answering to the modes", "error", err.Error())
	}
}

// obey takes new modes. They are in the kernel when it returns without an error, as far as anything is in the kernel yet.
func (g *Engine) obey(text []byte) error {
	modes, err := parseModes(text)
	if err != nil {
		slog.Error(err.Error())
		g.modeFile.answer(text, err)
		return nil // the modes stay as they were
	}
	slog.Info("modes", "modes", modes)
	g.modes = modes
	g.render.LetEstablishedLive(modes.Established)
	g.index.KeepVanished(modes.KeepVanished)
	g.pending = append(g.pending, change{cause: Cause{Kind: "Modes", Name: g.options.Node, Event: "set"}, received: time.Now()})
	g.absorb()
	if g.synced() {
		err = g.apply()
	}
	g.modeFile.answer(text, err)
	return err
}

// setPod brings a pod into the index. If its labels change, it keeps those of before, and its policy as it is, until relabelDue.
func (g *Engine) setPod(from change) bool {
	pod := from.pod
	known := g.index.Pod(pod.Key)
	if known == nil || known.UID != pod.UID {
		return g.index.SetPod(pod)
	}
	waiting := g.newest(from.cause)
	waits := waiting != nil && waiting.pod.UID == pod.UID
	switch {
	case waits && waiting.pod.SameIdentity(pod):
		waiting.pod = pod
	case !waits && (known.SameIdentity(pod) || !g.index.Freeze(pod.Key)):
		return g.index.SetPod(pod)
	default:
		g.relabels = append(g.relabels, from)
	}
	return g.index.SetPod(pod.WithLabelsOf(known))
}

// setNamespace does the same for a namespace and all of its pods.
func (g *Engine) setNamespace(from change) bool {
	name := from.cause.Name
	newest, known := g.index.Namespace(name)
	if !known {
		return g.index.SetNamespace(name, from.labels)
	}
	if waiting := g.newest(from.cause); waiting != nil {
		newest = waiting.labels
	}
	if !labels.Equals(newest, from.labels) {
		g.relabels = append(g.relabels, from)
		for _, pod := range g.index.PodsIn(name) {
			g.index.Freeze(pod.Key)
		}
	}
	return false
}

// newest returns the last change of an object's labels that waits, or nil.
func (g *Engine) newest(cause Cause) *change {
	for i := range slices.Backward(g.relabels) {
		if has := g.relabels[i].cause; has.Kind == cause.Kind && has.Namespace == cause.Namespace && has.Name == cause.Name {
			return &g.relabels[i]
		}
	}
	return nil
}

// relabelDue applies the changes of labels whose time has come, and returns when the next one is due; zero if none waits.
func (g *Engine) relabelDue(now time.Time) time.Time {
	for len(g.relabels) > 0 {
		next := g.relabels[0]
		if due := next.received.Add(g.modes.labelLag()); due.After(now) {
			return due
		}
		g.relabels = g.relabels[1:]
		for _, pod := range g.relabel(next) {
			if !g.waits(pod) {
				g.index.Thaw(pod.Key)
			}
		}
		g.pending = append(g.pending, next)
	}
	return time.Time{}
}

// relabel applies a change of labels, and returns the pods that it is about.
func (g *Engine) relabel(c change) []*policy.Pod {
	if c.pod == nil {
		if _, known := g.index.Namespace(c.cause.Name); known {
			g.index.SetNamespace(c.cause.Name, c.labels)
		}
		return g.index.PodsIn(c.cause.Name)
	}
	known := g.index.Pod(c.pod.Key)
	if known == nil || known.UID != c.pod.UID {
		return nil
	}
	g.index.SetPod(known.WithLabelsOf(c.pod))
	return []*policy.Pod{known}
}

// waits reports whether a change of the labels of a pod or of its namespace waits.
func (g *Engine) waits(pod *policy.Pod) bool {
	return slices.ContainsFunc(g.relabels, func(c change) bool {
		if c.pod == nil {
			return c.cause.Name == pod.Namespace
		}
		return c.pod.Key == pod.Key && c.pod.UID == pod.UID
	})
}
