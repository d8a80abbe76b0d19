package packettest

import (
	"context"
	"sync"
	"testing"
	"time"

	corev1 "k8s.io/api/core/v1"
	networkingv1 "k8s.io/api/networking/v1"
	apierrors "k8s.io/apimachinery/pkg/api/errors"
	"k8s.io/apimachinery/pkg/api/meta"
	metav1 "k8s.io/apimachinery/pkg/apis/meta/v1"
	"k8s.io/apimachinery/pkg/runtime"
	"k8s.io/apimachinery/pkg/runtime/schema"
	"k8s.io/apimachinery/pkg/runtime/serializer"
	"k8s.io/apimachinery/pkg/watch"
	k8stesting "k8s.io/client-go/testing"
	"k8s.io/client-go/tools/cache"

	"understudy/testcluster/understudy-netpol/internal/enforcer"
)

var kinds = map[string]schema.GroupVersion{
	"Pod": corev1.SchemeGroupVersion, "Namespace": corev1.SchemeGroupVersion, "NetworkPolicy": networkingv1.SchemeGroupVersion,
}

func resource(kind string) schema.GroupVersionResource {
	plural, _ := meta.UnsafeGuessKindToResource(kinds[kind].WithKind(kind))
	return plural
}

// fakeAPI is an API server in memory, client-go's own tracker of objects, that can be taken away.
type fakeAPI struct {
	scheme  *runtime.Scheme
	objects k8stesting.ObjectTracker

	mu    sync.Mutex
	away  bool
	asked int // while away
	opens int
	more  chan struct{}
	open  map[string][]watch.Interface // by kind
	// How many watches were cut. The tracker cannot tell what has happened since, as a real server can, so it says that
	// this is too long ago.
	expired map[string]int
}

func newAPI(t testing.TB) *fakeAPI {
	t.Helper()
	a := &fakeAPI{scheme: runtime.NewScheme(), more: make(chan struct{}), open: map[string][]watch.Interface{}, expired: map[string]int{}}
	must(t, corev1.AddToScheme(a.scheme))
	must(t, networkingv1.AddToScheme(a.scheme))
	a.objects = k8stesting.NewObjectTracker(a.scheme, serializer.NewCodecFactory(a.scheme).UniversalDecoder())
	return a
}

func (a *fakeAPI) api() enforcer.API {
	return enforcer.API{Pods: a.kind("Pod"), Namespaces: a.kind("Namespace"), NetworkPolicies: a.kind("NetworkPolicy")}
}

func (a *fakeAPI) kind(kind string) cache.ListerWatcherWithContext {
	return &cache.ListWatch{
		ListWithContextFunc: func(context.Context, metav1.ListOptions) (runtime.Object, error) {
			if err := a.refuse(""); err != nil {
				return nil, err
			}
			return a.objects.List(resource(kind), kinds[kind].WithKind(kind), "")
		},
		WatchFuncWithContext: func(context.Context, metav1.ListOptions) (watch.Interface, error) {
			if err := a.refuse(kind); err != nil {
				return nil, err
			}
			w, err := a.objects.Watch(resource(kind), "")
			if err != nil {
				return nil, err
			}
			a.mu.Lock()
			defer a.mu.Unlock()
			a.open[kind] = append(a.open[kind], w)
			a.opens++
			close(a.more)
			a.more = make(chan struct{})
			return w, nil
		},
	}
}

func (a *fakeAPI) refuse(watched string) error {
	a.mu.Lock()
	defer a.mu.Unlock()
	if a.away {
		if a.asked++; a.asked%2 == 0 {
			return context.DeadlineExceeded // nobody answers
		}
		return apierrors.NewServiceUnavailable("away") // or something before it does
	}
	if a.expired[watched] > 0 {
		a.expired[watched]--
		return apierrors.NewResourceExpired("too old")
	}
	return nil
}

// leave takes the API away: watches end, and requests are refused.
func (a *fakeAPI) leave() {
	a.mu.Lock()
	a.away = true
	var cut []watch.Interface
	for kind, open := range a.open {
		a.expired[kind] = len(open)
		cut = append(cut, open...)
	}
	a.open = map[string][]watch.Interface{}
	a.mu.Unlock()
	for _, w := range cut {
		w.Stop()
	}
}

func (a *fakeAPI) comeBack() {
	a.mu.Lock()
	defer a.mu.Unlock()
	a.away = false
}

func (a *fakeAPI) begun() int {
	a.mu.Lock()
	defer a.mu.Unlock()
	return a.opens
}

func (a *fakeAPI) waitBegun(t testing.TB, n int) {
	t.Helper()
	deadline := time.After(10 * time.Second)
	for {
		a.mu.Lock()
		opens, more := a.opens, a.more
		a.mu.Unlock()
		if opens >= n {
			return
		}
		select {
		case <-more:
		case <-deadline:
			t.Fatalf("%d of %d watches after 10 s", opens, n)
		}
	}
}

// set creates or replaces an object.
func (a *fakeAPI) set(t testing.TB, object runtime.Object) {
	t.Helper()
	kind, about := a.about(t, object)
	err := a.objects.Update(resource(kind), object, about.GetNamespace())
	if apierrors.IsNotFound(err) {
		err = a.objects.Create(resource(kind), object, about.GetNamespace())
	}
	must(t, err)
}

func (a *fakeAPI) remove(t testing.TB, object runtime.Object) {
	t.Helper()
	kind, about := a.about(t, object)
	must(t, a.objects.Delete(resource(kind), about.GetNamespace(), about.GetName()))
}

func (a *fakeAPI) about(t testing.TB, object runtime.Object) (kind string, about metav1.Object) {
	t.Helper()
	known, _, err := a.scheme.ObjectKinds(object)
	must(t, err)
	about, err = meta.Accessor(object)
	must(t, err)
	return known[0].Kind, about
}

func (a *fakeAPI) policies(t testing.TB) []networkingv1.NetworkPolicy {
	t.Helper()
	list, err := a.objects.List(resource("NetworkPolicy"), kinds["NetworkPolicy"].WithKind("NetworkPolicy"), "")
	must(t, err)
	return list.(*networkingv1.NetworkPolicyList).Items
}
