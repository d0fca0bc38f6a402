"""What participants ask for over HTTP: pages, answers, the state of their server, the relays."""
