"""The ways to have a cluster: one module each, all with the face of `base.Provider`."""
