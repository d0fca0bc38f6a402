"""An installation on the emulator ministack: the real template with the real functions and their roles."""
