package policy

// KeepVanished sets whether a pod of this node that is deleted before its network keeps what it was allowed last, until its
// network is gone. Without it, and for pods whose network is gone already, a deleted pod is forgotten. Switching it off
// forgets the pods that were kept.
func (x *Index) KeepVanished(keep bool) {
	x.keeps = keep
	if keep {
		return
	}
	for key, pod := range x.pods {
		if pod.vanished {
			x.release(key)
		}
	}
}

// vanishedKey is a key that no pod of the API can have, so that the next pod of that name is another one.
func vanishedKey(pod Key, uid string) Key { return Key{pod.Namespace, pod.Name + " " + uid} }

func (x *Index) keep(pod *tracked) {
	kept := *pod.Pod
	kept.Reported = nil
	for id := range x.byPod[pod.Key] {
		if sandbox := x.sandboxes[id]; sandbox.UID == pod.UID {
			kept.Reported = append(kept.Reported, sandbox.Addrs...)
		}
	}
	if pod.Node != x.node || len(kept.Reported) == 0 || pod.HostNetwork || pod.Ended {
		return
	}
	endpoint, policies := x.endpoint(pod), x.policiesOf(pod.Pod)
	for _, policy := range policies {
		x.use(policy)
	}
	kept.Key = vanishedKey(pod.Key, pod.UID)
	x.replacePod(kept.Key, &tracked{Pod: &kept, endpoint: endpoint, vanished: true, kept: policies})
}

// release forgets a vanished pod, if there is one of that key.
func (x *Index) release(key Key) {
	pod := x.pods[key]
	if pod == nil {
		return
	}
	x.replacePod(key, nil)
	for _, policy := range pod.kept {
		x.leave(policy)
	}
}
