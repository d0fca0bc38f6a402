"""What tests and benches share; nothing in the product imports it."""
