"""The control plane: pure records and transitions, the services over them, and the ports on AWS."""
