"""The version whose interface this is: the last that was in wide use before `step` had five values."""

VERSION = "0.21.0"
