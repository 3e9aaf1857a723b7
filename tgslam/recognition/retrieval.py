"""Which earlier images resemble one: a bag of binary words, kept as an inverted index.

Words are some bits of a descriptor, drawn once and for all: several draws, so that two descriptors of the same corner,
which differ in a few bits, share a word of most draws. No vocabulary is trained, and none has to be shipped.
"""

from __future__ import annotations

from itertools import chain

import numpy as np
from numpy.typing import NDArray

_DRAWS = 4  # with 30 of 256 bits off, a corner keeps a given word in one case of six, and one of four in one of two
_BITS = 14  # of a word: longer ones survive no noise, shorter ones are in every image
_SEED = 20240  # any; words have to be the same in every run
_WORDS = 1 << _BITS  # of a draw


class Retrieval:
    """Images by the words that they hold; how often an image repeats a word does not count."""

    def __init__(self) -> None:
        rng = np.random.default_rng(_SEED)
        self._bits = np.stack([rng.choice(256, _BITS, replace=False) for _ in range(_DRAWS)])
        self._images: list[list[int]] = [[] for _ in range(_DRAWS * _WORDS)]  # that hold each word, ascending
        self._held = np.zeros(_DRAWS * _WORDS, np.int32)  # by how many
        self._sizes: list[int] = []  # words of each image

    def __len__(self) -> int:
        return len(self._sizes)

    def words(self, descriptors: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Distinct words, ascending, of descriptors [N, 32]."""
        bits = np.unpackbits(descriptors, axis=1)[:, self._bits]  # [N, draws, bits of a word]
        values = bits.astype(np.int64) @ (1 << np.arange(_BITS))
        return np.unique(values + _WORDS * np.arange(_DRAWS))

    def add(self, words: NDArray[np.int64]) -> None:
        """The next image."""
        image = len(self)
        for word in words.tolist():
            self._images[word].append(image)
        self._held[words] += 1
        self._sizes.append(len(words))

    def scores(self, words: NDArray[np.int64]) -> NDArray[np.float64]:
        """[images] how much each resembles one with these words: rare words that it holds too, for its size."""
        held = self._held[words]
        weight = np.repeat(np.log((1.0 + len(self)) / np.maximum(held, 1)), held)
        images = np.fromiter(chain.from_iterable(self._images[word] for word in words.tolist()), np.int64, len(weight))
        total = np.bincount(images, weight, minlength=len(self))
        return np.asarray(total / np.sqrt(np.maximum(self._sizes, 1.0)), np.float64)
