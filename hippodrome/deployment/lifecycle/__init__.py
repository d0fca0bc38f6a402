"""An installation from the first `hippodrome deploy` until `hippodrome destroy`."""
