"""The version of Gym whose interface this package has: the last in wide use before `step` returned five values."""

VERSION = "0.21.0"
