"""The process of a trial server: its lifetime, its port, and the admission of clients."""
