package policy

import (
	"net/netip"
	"slices"
)

// Has reports whether the address is in the list.
func (a *Addresses) Has(addr netip.Addr) bool {
	_, found := slices.BinarySearchFunc(a.List, addr, netip.Addr.Compare)
	return found
}

func compareTargets(a, b Target) int {
	if c := a.Addr.Compare(b.Addr); c != 0 {
		return c
	}
	return int(a.Port) - int(b.Port)
}

// collection is a set that hands out sorted, unchanging lists of itself. A few changes are worked into a copy of the last
// list; after many it is sorted again, so that the first listing of a large cluster is not quadratic.
type collection[T comparable] struct {
	compare func(a, b T) int
	members map[T]struct{}
	touched []T
	list    []T
	fresh   bool
}

func newCollection[T comparable](compare func(a, b T) int) *collection[T] {
	return &collection[T]{compare: compare, members: map[T]struct{}{}}
}

func (c *collection[T]) put(item T, member bool) {
	if _, is := c.members[item]; is == member {
		return
	}
	if member {
		c.members[item] = struct{}{}
	} else {
		delete(c.members, item)
	}
	c.touched = append(c.touched, item)
	c.fresh = false
}

// sorted returns the list, and whether it is another one than last time.
func (c *collection[T]) sorted() ([]T, bool) {
	if c.fresh {
		return c.list, false
	}
	if len(c.touched) > 4+len(c.list)/16 {
		list := make([]T, 0, len(c.members))
		for item := range c.members {
			list = append(list, item)
		}
		slices.SortFunc(list, c.compare)
		c.list = list
	} else {
		list := slices.Grow(slices.Clone(c.list), len(c.touched))
		for _, item := range c.touched {
			at, found := slices.BinarySearchFunc(list, item, c.compare)
			if _, member := c.members[item]; member && !found {
				list = slices.Insert(list, at, item)
			} else if !member && found {
				list = slices.Delete(list, at, at+1)
			}
		}
		c.list = list
	}
	c.touched, c.fresh = c.touched[:0], true
	return c.list, true
}
