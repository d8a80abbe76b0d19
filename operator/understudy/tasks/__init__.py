"""The task proxy: clients talk to it, and their goals outlive the instance that works on them."""
