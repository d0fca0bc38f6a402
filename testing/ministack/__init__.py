"""An installation on ministack: the real template with the real functions and their roles."""
