"""The CustomResourceDefinitions, generated from the models. The models themselves are in `api.kinds`."""
