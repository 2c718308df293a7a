"""Bags of binary words: a tree of k-majority clusters over ORB descriptors, and TF-IDF scores.

The tree is grown from the run's own key frames, and again whenever there are three times as many:
nothing has to be shipped or downloaded, and words fit the place. Same descriptors, same tree.

References
----------
.. [1] D. Galvez-Lopez, J. D. Tardos, "Bags of Binary Words for Fast Place Recognition in Image
   Sequences", T-RO 28(5), 2012.
.. [2] C. Grana et al., "A Fast Approach for Integrating ORB Descriptors in the Bag of Words Model",
   SPIE 8667, 2013: k-majority.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Descriptors = NDArray[np.uint8]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]

BRANCHES: Final = 10
DEPTH: Final = 3
ROUNDS: Final = 6
MOST_TRAINED: Final = 10_000
"""Descriptors that a tree is grown from at most."""
FIRST_FRAMES: Final = 20
"""Key frames of the first tree: a loop is not looked for before."""
GROWTH: Final = 3.0


def hamming(a: Descriptors, b: Descriptors) -> NDArray[np.int64]:
    """Return how many bits differ, broadcast over (..., 32)."""
    words_a, words_b = (np.ascontiguousarray(x).view(np.uint64) for x in (a, b))
    return np.asarray(np.bitwise_count(words_a ^ words_b).sum(axis=-1, dtype=np.int64))


class WordTree:
    """Words as leaves of a tree; a descriptor goes to the nearest child at each level."""

    def __init__(self, descriptors: Descriptors, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        if len(descriptors) > MOST_TRAINED:
            kept = rng.choice(len(descriptors), MOST_TRAINED, replace=False)
            descriptors = descriptors[np.sort(kept)]
        self.centres: list[Descriptors] = []
        """By level, (nodes, BRANCHES, 32)"""
        node = np.zeros(len(descriptors), dtype=np.int64)
        for level in range(DEPTH):
            n_nodes = BRANCHES**level
            centres = np.zeros((n_nodes, BRANCHES, 32), dtype=np.uint8)
            label = np.zeros(len(descriptors), dtype=np.int64)
            order = np.argsort(node, kind="stable")
            ends = np.searchsorted(node[order], np.arange(n_nodes + 1))
            for k in range(n_nodes):
                members = order[ends[k] : ends[k + 1]]
                if len(members):
                    centres[k], label[members] = _clusters(descriptors[members], rng)
            self.centres.append(centres)
            node = node * BRANCHES + label

    @property
    def n_words(self) -> int:
        """Leaves of the tree."""
        return BRANCHES**DEPTH

    def words(self, descriptors: Descriptors) -> Indices:
        """Return the word (n,) of each descriptor (n, 32)."""
        node = np.zeros(len(descriptors), dtype=np.int64)
        for centres in self.centres:
            distance = hamming(descriptors[:, None], centres[node])
            node = node * BRANCHES + distance.argmin(axis=1)
        return node


def _clusters(members: Descriptors, rng: np.random.Generator) -> tuple[Descriptors, Indices]:
    """Return centres (BRANCHES, 32) and the cluster (n,) of each descriptor."""
    distinct = np.unique(members, axis=0)
    chosen = rng.permutation(len(distinct))[:BRANCHES]
    centres = distinct[chosen]
    if len(centres) < BRANCHES:  # few members: the rest repeats the first and stays empty
        centres = np.concatenate([centres, np.repeat(centres[:1], BRANCHES - len(centres), axis=0)])
    label = hamming(members[:, None], centres[None]).argmin(axis=1)
    bits = np.unpackbits(members, axis=1).astype(np.float32)
    for _ in range(ROUNDS):
        is_member = (label == np.arange(BRANCHES)[:, None]).astype(np.float32)
        size = is_member.sum(axis=1, keepdims=True)
        majority = np.packbits(2.0 * (is_member @ bits) > size, axis=1)
        centres = np.where(size > 0.0, majority, centres)
        after = hamming(members[:, None], centres[None]).argmin(axis=1)
        if np.array_equal(after, label):
            break
        label = after
    return centres, label


class PlaceIndex:
    """Bags of words of key frames, and how alike two of them are, from 0 to 1."""

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self._tree: WordTree | None = None
        self._grown_at = 0
        self._kept: list[Descriptors] = []
        self._counts = np.zeros((0, BRANCHES**DEPTH), dtype=np.float32)
        self._bags = self._counts

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def is_ready(self) -> bool:
        """Whether there are words yet."""
        return self._tree is not None

    def add(self, descriptors: Descriptors) -> int:
        """Add a key frame's descriptors (n, 32) and return its number, counted from 0."""
        self._kept.append(descriptors)
        n = len(self._kept)
        if n >= FIRST_FRAMES and n >= GROWTH * self._grown_at:
            self._tree = WordTree(np.concatenate(self._kept), self._seed)
            self._grown_at = n
            self._counts = np.stack([self._count(one) for one in self._kept])
            self._weigh()
        elif self._tree is not None:
            self._counts = np.concatenate([self._counts, self._count(descriptors)[None]])
            self._bags = np.concatenate([self._bags, self._bag(self._counts[-1:])])
        return n - 1

    def scores(self, descriptors: Descriptors) -> Array:
        """Return how alike each key frame (K,) is: 1 for the same bag, 0 for no word shared."""
        if self._tree is None:
            return np.zeros(len(self._kept))
        bag = self._bag(self._count(descriptors)[None])[0]
        shared = np.flatnonzero(bag)
        common = np.minimum(self._bags[:, shared], bag[shared])
        return np.asarray(common.sum(axis=1, dtype=np.float64))

    def _count(self, descriptors: Descriptors) -> NDArray[np.float32]:
        assert self._tree is not None
        words = self._tree.words(descriptors)
        return np.bincount(words, minlength=self._tree.n_words).astype(np.float32)

    def _weigh(self) -> None:
        seen = (self._counts > 0).sum(axis=0)
        self._idf = np.log(len(self._counts) / np.maximum(seen, 1)).astype(np.float32)
        self._bags = self._bag(self._counts)

    def _bag(self, counts: NDArray[np.float32]) -> NDArray[np.float32]:
        weighted = counts * self._idf
        total = np.maximum(weighted.sum(axis=1, keepdims=True), np.float32(1e-9))
        return np.asarray(weighted / total)
