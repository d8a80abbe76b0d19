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
			x.replacePod(key, nil)
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
	kept.Key = vanishedKey(pod.Key, pod.UID)
	frozen := x.frozen(&kept, pod)
	frozen.vanished = true
	x.replacePod(kept.Key, frozen)
}
