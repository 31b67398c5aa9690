# SPDX-License-Identifier: Apache-2.0
import numpy as np

from blitzgs.training.sampler import tour_of
from tests.training.tiny import Camera

K = np.array([[60.0, 0.0, 32.0], [0.0, 60.0, 32.0], [0.0, 0.0, 1.0]])


def oblique(place, azimuth, height=10.0):
    """A camera at (x, y, height) that looks 45 degrees down, at a place `height` away."""
    forward = np.array([np.cos(azimuth), np.sin(azimuth), -1.0]) / np.sqrt(2)
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(forward, right), forward))
    pose[:3, 3] = -pose[:3, :3] @ np.append(place, height)
    return Camera("view", 64, 64, K, pose)


def test_neighbours_of_a_tour_show_the_same_places():
    """Four oblique cameras a place: those that show the same place are elsewhere, and look elsewhere."""
    centres = [(x, y) for x in range(0, 80, 10) for y in range(0, 80, 10)]
    azimuths = np.arange(4) * np.pi / 2
    cameras = [oblique(centre, azimuth) for centre in centres for azimuth in azimuths]
    shown = np.array([np.array(c) + 10 * np.array((np.cos(a), np.sin(a))) for c in centres for a in azimuths])
    grid = np.arange(-20.0, 92.0, 1.5)
    points = np.stack((*np.meshgrid(grid, grid), np.zeros((len(grid), len(grid)))), axis=-1).reshape(-1, 3)
    order = tour_of(cameras, points)
    assert sorted(order) == list(range(len(cameras)))

    def step(places):
        return float(np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)))

    random = np.random.default_rng(0).permutation(len(cameras))
    # Neighbours show the same place or the next one, 10 away; along the flight it is 14.
    assert step(shown[order]) < 10.1
    assert step(shown) > 14.0
    assert step(shown[random]) > 30.0


def test_cameras_without_points_are_visited_by_their_own_places():
    centres = np.random.default_rng(1).permutation(np.arange(16.0))
    cameras = [oblique((x, 0.0), 0.0) for x in centres]
    assert centres[tour_of(cameras, np.zeros((0, 3)))].tolist() == sorted(centres)
