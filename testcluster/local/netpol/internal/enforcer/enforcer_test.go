package enforcer

import (
	"context"
	"errors"
	"fmt"
	"net/http/httptest"
	"os"
	"path/filepath"
	"strings"
	"testing"
	"time"

	corev1 "k8s.io/api/core/v1"
	apierrors "k8s.io/apimachinery/pkg/api/errors"
	metav1 "k8s.io/apimachinery/pkg/apis/meta/v1"
	"k8s.io/apimachinery/pkg/runtime/schema"

	"understudy/testcluster/understudy-netpol/internal/nft"
)

const result = `{"kind":"cniCacheV1","containerId":"8d0","config":"e30=","ifName":"eth0","networkName":"pods",
 "cniArgs":[["IgnoreUnknown","1"],["K8S_POD_NAMESPACE","fleet"],["K8S_POD_NAME","nav"],["K8S_POD_INFRA_CONTAINER_ID","8d0"],["K8S_POD_UID","u-1"]],
 "capabilityArgs":{"dns":{}},
 "result":{"cniVersion":"1.0.0","interfaces":[{"name":"veth1","mac":"aa"},{"name":"eth0","mac":"bb","sandbox":"/run/netns/x"}],
  "ips":[{"interface":1,"address":"10.245.1.5/24","gateway":"10.245.1.1"},{"interface":1,"address":"fd00::5/64"}],"dns":{}}}`

func TestParseSandbox(t *testing.T) {
	sandbox, ok := parseSandbox([]byte(result))
	if !ok || sandbox.Pod.String() != "fleet/nav" || sandbox.UID != "u-1" || fmt.Sprint(sandbox.Addrs) != "[10.245.1.5 fd00::5]" {
		t.Errorf("got %+v, %t", sandbox, ok)
	}
	for what, text := range map[string]string{
		"loopback":         `{"ifName":"lo","cniArgs":[["K8S_POD_NAME","nav"]],"result":{"ips":[{"address":"127.0.0.1/8"},{"address":"::1/128"}]}}`,
		"no pod":           `{"ifName":"eth0","result":{"ips":[{"address":"10.245.1.5/24"}]}}`,
		"half written":     result[:200],
		"nothing":          "",
		"not a CNI result": `[1]`,
	} {
		if sandbox, ok := parseSandbox([]byte(text)); ok {
			t.Errorf("%s: got %+v", what, sandbox)
		}
	}
}

// TestSandboxesArePolledWhereTheyCannotBeWatched checks polling, which is used if the machine has no inotify instance left.
func TestSandboxesArePolledWhereTheyCannotBeWatched(t *testing.T) {
	q := newQueue()
	s := &sandboxes{t.TempDir(), q}
	go s.poll(t.Context(), map[string]bool{})
	file := filepath.Join(s.directory, "pods-8d0-eth0")
	if err := os.WriteFile(file, []byte(result), 0o600); err != nil {
		t.Fatal(err)
	}
	expectChange(t, q, "set")
	if err := os.Remove(file); err != nil {
		t.Fatal(err)
	}
	expectChange(t, q, "delete")
}

func expectChange(t *testing.T, q *queue, event string) {
	t.Helper()
	select {
	case <-q.ready:
	case <-time.After(5 * time.Second):
		t.Fatalf("no %s after 5 s", event)
	}
	if list, _ := q.take(time.Now()); len(list) != 1 || list[0].cause.Event != event {
		t.Fatalf("want one %s, got %+v", event, list)
	}
}

// TestAListSaysWhatHasGone deletes objects while the API server cannot be watched.
func TestAListSaysWhatHasGone(t *testing.T) {
	q := newQueue()
	s := podSource(q)
	pod := func(name string) *corev1.Pod {
		return &corev1.Pod{ObjectMeta: metav1.ObjectMeta{Namespace: "x", Name: name}}
	}
	events := func() string {
		text := ""
		list, _ := q.take(time.Now())
		for _, c := range list {
			text += c.cause.Event + " " + c.cause.Name + ","
		}
		return text
	}
	for _, step := range []struct {
		list []any
		want string
	}{
		{[]any{pod("a"), pod("b")}, "list a,list b,synced ,"},
		{[]any{pod("b"), pod("c")}, "list b,list c,delete a,"},
		{nil, "delete b,delete c,"},
	} {
		if err := s.Replace(step.list, "1"); err != nil {
			t.Fatal(err)
		}
		if got := events(); len(got) != len(step.want) || (len(step.list) > 0 && got != step.want) {
			t.Errorf("got %q, want %q", got, step.want)
		}
	}
}

func TestAnswersAndSilence(t *testing.T) {
	kind := schema.GroupResource{Resource: "pods"}
	for err, want := range map[error]bool{
		apierrors.NewResourceExpired("too old"):          true,
		apierrors.NewForbidden(kind, "", nil):            true,
		apierrors.NewUnauthorized("who?"):                true,
		apierrors.NewServiceUnavailable("not yet"):       false,
		apierrors.NewTooManyRequests("later", 1):         false,
		apierrors.NewInternalError(errors.New("etcd")):   false,
		errors.New("dial tcp: connection refused"):       false,
		fmt.Errorf("dial: %w", context.DeadlineExceeded): false,
	} {
		if got := answered(err); got != want {
			t.Errorf("%v: counts as an answer: %t, want %t", err, got, want)
		}
	}
}

func TestMetrics(t *testing.T) {
	r := NewReport()
	read := func(handler func(*Report, *httptest.ResponseRecorder)) (int, string) {
		recorder := httptest.NewRecorder()
		handler(r, recorder)
		return recorder.Code, recorder.Body.String()
	}
	ready := func(r *Report, w *httptest.ResponseRecorder) { r.Ready(w, nil) }
	if code, _ := read(ready); code != 503 {
		t.Errorf("ready before the first transaction: %d", code)
	}
	at := time.Unix(100, 7)
	cause := func(kind, name, version, event string) change {
		return change{cause: Cause{kind, "fleet", name, version, event}, received: at}
	}
	r.commit(newCommit([]change{cause("NetworkPolicy", "gate", "41", "set"), cause("Pod", "nav", "40", "set")}, nft.Changes{}, at, at, at.Add(time.Millisecond)))
	r.commit(newCommit([]change{cause("NetworkPolicy", "gone", "42", "set")}, nft.Changes{}, at, at, at))
	r.commit(newCommit([]change{cause("NetworkPolicy", "gone", "43", "delete")}, nft.Changes{}, at, at, at.Add(2*time.Millisecond)))
	code, text := read(func(r *Report, w *httptest.ResponseRecorder) { r.ServeHTTP(w, nil) })
	for _, line := range []string{
		`understudy_netpol_transactions_total{kinds="NetworkPolicy,Pod"} 1`,
		`understudy_netpol_transactions_total{kinds="NetworkPolicy"} 2`,
		`understudy_netpol_policy_commit_timestamp_nanoseconds{namespace="fleet",name="gate",resource_version="41"} 100001000007`,
		`understudy_netpol_last_commit_timestamp_nanoseconds 100002000007`,
		`understudy_netpol_latency_seconds_bucket{le="0.001"} 2`,
		`understudy_netpol_latency_seconds_bucket{le="+Inf"} 3`,
		`understudy_netpol_latency_seconds_count 3`,
		`understudy_netpol_failures_total 0`,
	} {
		if !strings.Contains(text, line+"\n") {
			t.Errorf("no line %s in\n%s", line, text)
		}
	}
	if code != 200 || strings.Contains(text, "gone") {
		t.Errorf("%d; a deleted policy must not be there:\n%s", code, text)
	}
	if code, _ := read(ready); code != 200 {
		t.Errorf("not ready after a transaction: %d", code)
	}
}
