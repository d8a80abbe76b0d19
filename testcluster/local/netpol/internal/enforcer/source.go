package enforcer

import (
	"context"
	"errors"
	"fmt"
	"log/slog"
	"sync/atomic"
	"time"

	corev1 "k8s.io/api/core/v1"
	networkingv1 "k8s.io/api/networking/v1"
	apierrors "k8s.io/apimachinery/pkg/api/errors"
	metav1 "k8s.io/apimachinery/pkg/apis/meta/v1"
	"k8s.io/apimachinery/pkg/fields"
	"k8s.io/apimachinery/pkg/labels"
	"k8s.io/apimachinery/pkg/runtime"
	"k8s.io/apimachinery/pkg/runtime/schema"
	"k8s.io/apimachinery/pkg/runtime/serializer"
	"k8s.io/apimachinery/pkg/watch"
	"k8s.io/client-go/rest"
	"k8s.io/client-go/tools/cache"

	"understudy/testcluster/understudy-netpol/internal/policy"
)

// source puts all objects of one kind into the queue, with a client-go reflector. The reflector writes directly to the
// queue, because an informer's own queue and its listeners would be two more steps on the measured path. The reflector's
// Replace shows which objects vanished while the API server could not be watched.
type source struct {
	kind   string
	queue  *queue
	known  map[policy.Key]struct{} // objects in the queue or taken; used by the reflector's goroutine only
	set    func(object any) change // its effect
	remove func(key policy.Key) func(*policy.Index) bool
	listed bool // used by the reflector's goroutine only
	broken atomic.Bool
}

func podSource(q *queue) *source {
	return &source{kind: "Pod", queue: q, known: map[policy.Key]struct{}{},
		set: func(object any) change { return change{pod: policy.FromPod(object.(*corev1.Pod))} },
		remove: func(key policy.Key) func(*policy.Index) bool {
			return func(x *policy.Index) bool { return x.DeletePod(key) }
		}}
}

func namespaceSource(q *queue) *source {
	return &source{kind: "Namespace", queue: q, known: map[policy.Key]struct{}{},
		set: func(object any) change { return change{labels: labels.Set(object.(*corev1.Namespace).Labels)} },
		remove: func(key policy.Key) func(*policy.Index) bool {
			return func(x *policy.Index) bool { return x.DeleteNamespace(key.Name) }
		}}
}

func policySource(q *queue) *source {
	return &source{kind: "NetworkPolicy", queue: q, known: map[policy.Key]struct{}{},
		set: func(object any) change {
			spec := object.(*networkingv1.NetworkPolicy)
			return change{apply: func(x *policy.Index) (bool, []error) { return x.SetPolicy(spec) }}
		},
		remove: func(key policy.Key) func(*policy.Index) bool {
			return func(x *policy.Index) bool { return x.DeletePolicy(key) }
		}}
}

// API is the source of the objects.
type API struct {
	Pods, Namespaces, NetworkPolicies cache.ListerWatcherWithContext
}

// Connect makes the API of a cluster. It does not use client-go's clients, which would import all groups of the API.
func Connect(config *rest.Config) (API, error) {
	scheme := runtime.NewScheme()
	if err := errors.Join(corev1.AddToScheme(scheme), networkingv1.AddToScheme(scheme)); err != nil {
		return API{}, err
	}
	config = rest.CopyConfig(config)
	config.NegotiatedSerializer = serializer.NewCodecFactory(scheme).WithoutConversion()
	config.ContentType = runtime.ContentTypeProtobuf
	client := func(path string, version schema.GroupVersion) (*rest.RESTClient, error) {
		config := rest.CopyConfig(config)
		config.APIPath, config.GroupVersion = path, &version
		return rest.RESTClientFor(config)
	}
	core, err := client("/api", corev1.SchemeGroupVersion)
	if err != nil {
		return API{}, err
	}
	networking, err := client("/apis", networkingv1.SchemeGroupVersion)
	if err != nil {
		return API{}, err
	}
	return API{
		Pods:            cache.NewListWatchFromClient(core, "pods", metav1.NamespaceAll, fields.Everything()),
		Namespaces:      cache.NewListWatchFromClient(core, "namespaces", metav1.NamespaceAll, fields.Everything()),
		NetworkPolicies: cache.NewListWatchFromClient(networking, "networkpolicies", metav1.NamespaceAll, fields.Everything()),
	}, nil
}

const (
	firstWait = 100 * time.Millisecond
	lastWait  = time.Second
)

// run lists and watches until the context ends. The reflector's own pause after errors grows to a minute, far too long
// after a restart of the API server; here it grows to one second.
func (s *source) run(ctx context.Context, from cache.ListerWatcherWithContext, example runtime.Object) {
	reflector := cache.NewReflectorWithOptions(&patient{from, s}, example, s, cache.ReflectorOptions{Name: s.kind})
	for wait := firstWait; ctx.Err() == nil; {
		err := reflector.ListAndWatchWithContext(ctx)
		if err == nil {
			wait = firstWait
		} else if ctx.Err() == nil {
			slog.Warn("watch failed, listing again", "kind", s.kind, "error", err.Error())
			wait = min(2*wait, lastWait)
		}
		sleep(ctx, wait)
	}
}

func sleep(ctx context.Context, d time.Duration) {
	select {
	case <-ctx.Done():
	case <-time.After(d):
	}
}

// patient tries again by itself in those cases in which the reflector would start its long pauses.
type patient struct {
	inner  cache.ListerWatcherWithContext
	source *source
}

func (p *patient) retry(ctx context.Context, verb string, try func() error) error {
	for wait := firstWait; ; wait = min(2*wait, lastWait) {
		err := try()
		if err == nil {
			if p.source.broken.Swap(false) {
				slog.Info("API server answers again", "kind", p.source.kind)
			}
			return nil
		}
		if ctx.Err() != nil || answered(err) {
			return err
		}
		if !p.source.broken.Swap(true) {
			slog.Warn("API server does not answer, keeping the rules", "kind", p.source.kind, "verb", verb, "error", err.Error())
		}
		sleep(ctx, wait)
	}
}

// answered reports whether the error is an answer that the reflector can handle, such as an expired resource version. It
// is false if the server is away, starting or ending.
func answered(err error) bool {
	var status apierrors.APIStatus
	return errors.As(err, &status) && !apierrors.IsServiceUnavailable(err) && !apierrors.IsTooManyRequests(err) && !apierrors.IsInternalError(err)
}

func (p *patient) ListWithContext(ctx context.Context, options metav1.ListOptions) (list runtime.Object, err error) {
	return list, p.retry(ctx, "list", func() (e error) { list, e = p.inner.ListWithContext(ctx, options); return e })
}

func (p *patient) WatchWithContext(ctx context.Context, options metav1.ListOptions) (w watch.Interface, err error) {
	return w, p.retry(ctx, "watch", func() (e error) { w, e = p.inner.WatchWithContext(ctx, options); return e })
}

func (p *patient) List(options metav1.ListOptions) (runtime.Object, error) {
	return p.ListWithContext(context.Background(), options)
}

func (p *patient) Watch(options metav1.ListOptions) (watch.Interface, error) {
	return p.WatchWithContext(context.Background(), options)
}

func keyOf(object metav1.Object) policy.Key {
	return policy.Key{Namespace: object.GetNamespace(), Name: object.GetName()}
}

func (s *source) cause(object metav1.Object, event string) Cause {
	return Cause{s.kind, object.GetNamespace(), object.GetName(), object.GetResourceVersion(), event}
}

func (s *source) put(object any, event string, received time.Time) error {
	about, ok := object.(metav1.Object)
	if !ok {
		return fmt.Errorf("%s: unexpected %T in the watch", s.kind, object)
	}
	s.known[keyOf(about)] = struct{}{}
	c := s.set(object)
	c.cause, c.received = s.cause(about, event), received
	s.queue.put(c)
	return nil
}

func (s *source) drop(key policy.Key, cause Cause, received time.Time) {
	delete(s.known, key)
	apply := s.remove(key)
	s.queue.put(change{cause: cause, received: received, apply: func(x *policy.Index) (bool, []error) { return apply(x), nil }})
}

// Add, Update, Delete, Replace and Resync are what a reflector calls, all from one goroutine.
func (s *source) Add(object any) error { return s.put(object, "set", time.Now()) }

func (s *source) Update(object any) error { return s.put(object, "set", time.Now()) }

func (s *source) Delete(object any) error {
	received := time.Now()
	about, ok := object.(metav1.Object)
	if !ok {
		return fmt.Errorf("%s: unexpected %T in the watch", s.kind, object)
	}
	s.drop(keyOf(about), s.cause(about, "delete"), received)
	return nil
}

func (s *source) Replace(list []any, _ string) error {
	received := time.Now()
	before := s.known
	s.known = make(map[policy.Key]struct{}, len(list))
	for _, object := range list {
		if err := s.put(object, "list", received); err != nil {
			return err
		}
	}
	for key := range before {
		if _, still := s.known[key]; !still {
			s.drop(key, Cause{s.kind, key.Namespace, key.Name, "", "delete"}, received)
		}
	}
	if !s.listed {
		// Through the queue, so that it takes effect only after all earlier changes have been taken.
		s.listed = true
		s.queue.put(change{cause: Cause{Kind: s.kind, Event: synced}, received: received,
			apply: func(*policy.Index) (bool, []error) { return true, nil }})
	}
	return nil
}

func (s *source) Resync() error { return nil }
