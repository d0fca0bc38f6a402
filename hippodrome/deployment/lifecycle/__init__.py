"""An installation from the first `make deploy` until `make destroy`."""
