package policy

import "k8s.io/apimachinery/pkg/labels"

// Freeze leaves a pod the policy that it has now, whatever changes, until Thaw. False if it has no network yet.
func (x *Index) Freeze(key Key) bool {
	pod := x.pods[key]
	if pod == nil || len(pod.addrs) == 0 {
		return false
	}
	if !pod.frozen {
		x.replacePod(key, x.frozen(pod.Pod, pod))
	}
	return true
}

// Thaw gives a frozen pod the policy that it should have.
func (x *Index) Thaw(key Key) {
	if pod := x.pods[key]; pod != nil && pod.frozen {
		x.replacePod(key, &tracked{Pod: pod.Pod})
	}
}

// PodsIn returns the pods of a namespace.
func (x *Index) PodsIn(namespace string) []*Pod {
	var pods []*Pod
	for _, pod := range x.pods {
		if pod.Namespace == namespace && !pod.vanished {
			pods = append(pods, pod.Pod)
		}
	}
	return pods
}

// Namespace returns the labels of a namespace; false if it is not known.
func (x *Index) Namespace(name string) (labels.Set, bool) {
	set, known := x.namespaces[name]
	return set, known
}

// frozen is a pod that keeps the policy of another one.
func (x *Index) frozen(pod *Pod, like *tracked) *tracked {
	policies := x.policiesOf(like)
	for _, policy := range policies {
		x.use(policy)
	}
	return &tracked{Pod: pod, endpoint: x.endpoint(like), frozen: true, kept: policies}
}

// next is a pod after a change; it stays frozen.
func (x *Index) next(old *tracked, pod *Pod) *tracked {
	if old != nil && old.frozen && old.UID == pod.UID {
		return x.frozen(pod, old)
	}
	return &tracked{Pod: pod}
}
