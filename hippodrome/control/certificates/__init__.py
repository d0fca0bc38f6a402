"""The certificate of the servers' names: when to renew it, the ACME order, and the renewal."""
