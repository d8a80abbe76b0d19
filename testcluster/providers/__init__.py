"""The ways to have a cluster: one module each, all with the interface of `base.Provider`."""
