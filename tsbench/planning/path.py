"""Paths: polylines that a motion follows, independent of time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tsbench.core.arrays import Array, array_namespace, like, norm

_BEFORE_AND_AFTER = np.array([-1, 0])  # the segments at a vertex


def segment_distance(point: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Distance of a point (d,) from each straight segment between `first` and `second`, each of
    shape (n, d); shape (n,)."""
    along = second - first
    squared = np.maximum(np.sum(along * along, axis=-1), 1e-300)
    share = np.clip(np.sum((point - first) * along, axis=-1) / squared, 0.0, 1.0)
    nearest = first + share[:, None] * along
    distance: np.ndarray = np.linalg.norm(point - nearest, axis=-1)
    return distance


@dataclass(frozen=True)
class Path:
    """A polyline with many short segments of similar length.

    Attributes:
        vertices: metres, shape (n, 2).
        lengths: metres along the path from the first vertex to each vertex, shape (n,).
    """

    vertices: np.ndarray
    lengths: np.ndarray

    @classmethod
    def through(cls, points: np.ndarray) -> Path:
        """The polyline through points in metres, shape (n, 2), without consecutive duplicates."""
        moved = np.linalg.norm(np.diff(points, axis=0), axis=-1)
        keep = np.concatenate([[True], moved > 1e-9])
        return cls(points[keep], np.concatenate([[0.0], np.cumsum(moved[moved > 1e-9])]))

    def project(self, position: Array) -> tuple[Array, Array]:
        """Distance to the nearest point in metres and the share of the path before it, each of
        shape (...,), for positions in metres, shape (..., 2).

        Only the two segments at the nearest vertex are considered. If segments are short and of
        similar length, another one is nearer by a fraction of a segment at most.
        """
        xp = array_namespace(position)
        vertices, lengths = like(position, self.vertices), like(position, self.lengths)
        if len(self.vertices) == 1:
            distance = norm(position - vertices[0])
            return distance, 0.0 * distance
        # |p - v|^2 - |p|^2, which has its minimum at the same vertex. Written as sums: a matrix
        # product would round differently for one position than for many.
        squared = (
            xp.sum(vertices * vertices, axis=-1)
            - 2.0 * position[..., None, 0] * vertices[:, 0]
            - 2.0 * position[..., None, 1] * vertices[:, 1]
        )
        nearest = xp.argmin(squared, axis=-1)[..., None] + like(position, _BEFORE_AND_AFTER)
        index = xp.clip(nearest, 0, len(self.vertices) - 2)  # of the two segments, shape (..., 2)
        a, b = vertices[index], vertices[index + 1]
        along = b - a
        length = lengths[index + 1] - lengths[index]
        position = position[..., None, :]
        share = xp.sum((position - a) * along, axis=-1) / (length * length)
        share = xp.clip(share, 0.0, 1.0)
        distance = norm(position - (a + share[..., None] * along))
        travelled = (lengths[index] + share * length) / lengths[-1]
        first = distance[..., 0] <= distance[..., 1]
        return (
            xp.where(first, distance[..., 0], distance[..., 1]),
            xp.where(first, travelled[..., 0], travelled[..., 1]),
        )
