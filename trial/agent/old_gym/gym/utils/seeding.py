"""Random numbers, by a generator with the methods of NumPy's Generator and of RandomState, which Gym used earlier."""

from typing import Any

import numpy as np
from gymnasium import error


class RandomNumberGenerator(np.random.Generator):
    """A NumPy Generator that has RandomState's methods, too."""

    def rand(self, *shape: int) -> Any:
        """Numbers in [0, 1)."""
        return self.random(shape or None)

    def random_sample(self, size: Any = None) -> Any:
        """Numbers in [0, 1)."""
        return self.random(size)

    def randn(self, *shape: int) -> Any:
        """Draw normally distributed numbers."""
        return self.standard_normal(shape or None)

    def randint(self, low: Any, high: Any = None, size: Any = None, dtype: Any = int) -> Any:
        """Draw whole numbers from `low` to below `high`."""
        return self.integers(low, high, size, dtype)


RNG = RandomNumberGenerator


def np_random(seed: Any = None) -> tuple[RandomNumberGenerator, int]:
    """Make a generator. Return it and its seed (random for None). Raises gym.error.Error for an invalid seed."""
    if seed is not None and not (isinstance(seed, int | np.integer) and seed >= 0):
        raise error.Error(f"Seed must be a non-negative integer or omitted, not {seed}")
    sequence = np.random.SeedSequence(None if seed is None else int(seed))
    entropy = sequence.entropy
    assert isinstance(entropy, int)
    return RandomNumberGenerator(np.random.PCG64(sequence)), entropy


def create_seed(seed: Any = None, max_bytes: int = 8) -> int:
    """Return the seed as an int; a random one of at most `max_bytes` bytes if it is None."""
    bits: int = 8 * max_bytes
    return np_random()[1] % (1 << bits) if seed is None else int(seed)


def hash_seed(seed: Any = None, max_bytes: int = 8) -> int:
    """Return another seed, which depends on this one alone."""
    words = np.random.SeedSequence(create_seed(seed)).generate_state(2)
    bits: int = 8 * max_bytes
    return (int(words[0]) << 32 | int(words[1])) % (1 << bits)
