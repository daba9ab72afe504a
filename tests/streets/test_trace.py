"""Ray tracing against marching."""

import numpy as np
import pytest

from occdetr.geometry.kitti import kitti_camera
from occdetr.streets.foliage import LEAF, leaf_in
from occdetr.streets.ground import KERB
from occdetr.streets.solids import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    LEAFY_BOX,
    LEAFY_CONE,
    LEAFY_ELLIPSOID,
    WHEEL,
)
from occdetr.streets.trace import GROUND, NOTHING, build_index, lit, trace
from occdetr.streets.world import World
from street_solids import flat_terrain, one_solid


@pytest.fixture(scope="module")
def snapshot():
    return World(seed=0, split=0, index=7).snapshot()


def inside(solids, points):
    """Which points are in the solid, by its definition."""
    g, form = solids.geometry[0], solids.forms[0]
    p = points - g[:3]
    x, y, z = g[3] * p[:, 0] + g[4] * p[:, 1], g[3] * p[:, 1] - g[4] * p[:, 0], p[:, 2]
    s = (z + g[7]) / (2 * g[7])
    if form == BOX:
        wide_x, wide_y = g[5] * (1 + (g[8] - 1) * s), g[6] * (1 + (g[9] - 1) * s)
        ahead = np.abs(x - g[10] * g[5] * s) <= wide_x
        return ahead & (np.abs(y) <= wide_y) & (s >= 0) & (s <= 1)
    if form == CYLINDER:
        wide = 1 + (g[8] - 1) * s
        return ((x / g[5]) ** 2 + (y / g[6]) ** 2 <= wide**2) & (s >= 0) & (s <= 1)
    if form == WHEEL:
        radius = np.hypot(x, z)
        return (radius <= g[5]) & (radius >= g[8] * g[5]) & (np.abs(y) <= g[6])
    return (x / g[5]) ** 2 + (y / g[6]) ** 2 + (z / g[7]) ** 2 <= 1


def rays_at_origin(rng, count):
    origins = rng.normal(0, 1, (count, 3))
    origins *= 4 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.normal(0, 0.8, (count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("form", [BOX, CYLINDER, WHEEL, ELLIPSOID])
def test_ray_hits_equal_marching(form):
    rng, step = np.random.default_rng(form), 0.004
    times = np.arange(0.05, 8, step)
    hits_seen = 0
    for _ in range(20):
        solids = one_solid(form, rng)
        index = build_index(solids, flat_terrain())
        origins, directions = rays_at_origin(rng, 40)
        hits = trace(index, origins, directions)
        for ray in range(len(origins)):
            points = origins[ray] + times[:, None] * directions[ray]
            if inside(solids, origins[ray : ray + 1])[0]:
                continue  # surfaces are not hit from inside
            entered = np.flatnonzero(inside(solids, points) & (points[:, 2] > -5))
            met = hits.solids[ray] == 0
            if len(entered):
                within = len(entered) > 3  # marching can miss a corner with less than three steps
                assert met or not within
                if met:
                    assert abs(hits.distances[ray] - times[entered[0]]) < 2 * step or not within
                    hits_seen += 1
                    assert hits.normals[ray] @ directions[ray] < 1e-6
                    assert np.linalg.norm(hits.normals[ray]) == pytest.approx(1, abs=1e-4)
            elif met:  # a corner between two steps, but the point is on the surface
                point = origins[ray] + hits.distances[ray] * directions[ray]
                shaken = point + rng.normal(0, 0.004, (200, 3))
                assert inside(solids, shaken).any()
    assert hits_seen > 200


@pytest.mark.parametrize("form", [LEAFY_ELLIPSOID, LEAFY_CONE, LEAFY_BOX])
def test_rays_hit_leaves_only_in_their_cells(form):
    rng = np.random.default_rng(form)
    solids = one_solid(form, rng, density=0.5)
    index = build_index(solids, flat_terrain())
    origins, directions = rays_at_origin(rng, 2000)
    hits = trace(index, origins, directions)
    met = np.flatnonzero(hits.solids == 0)
    assert len(met) > 100
    g = solids.geometry[0]
    points = origins[met] + hits.distances[met, None] * directions[met] - g[:3]
    x, y = g[3] * points[:, 0] + g[4] * points[:, 1], g[3] * points[:, 1] - g[4] * points[:, 0]
    cells = np.floor(np.stack([x, y, points[:, 2]], axis=1) / LEAF).astype(int)
    around = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    for cell in cells:
        assert any(leaf_in(g, form, 0, *(cell + shift)) for shift in around)
    alone = 0
    for cell in rng.integers(-8, 8, (300, 3)):
        alone += leaf_in(g, form, 0, *cell)
    assert 0 < alone < 300


def test_downward_rays_hit_the_ground_at_its_height(snapshot):
    terrain = snapshot.world.scene.terrain
    empty = build_index(one_solid(BOX, np.random.default_rng(0)), terrain)
    rng = np.random.default_rng(1)
    places = np.stack([rng.uniform(4, 60, 500), rng.uniform(-30, 30, 500)], axis=1)
    origins = np.concatenate([places, np.full((500, 1), 30.0)], axis=1)
    down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
    hits = trace(empty, origins, np.ascontiguousarray(down))
    assert (hits.solids == GROUND).all()
    expected = [terrain.height(*place) for place in places]
    np.testing.assert_allclose(30.0 - hits.distances, expected, atol=KERB)
    assert np.median(np.abs(30.0 - hits.distances - expected)) < 0.01


def test_slanted_rays_hit_the_ground_where_they_first_reach_it(snapshot):
    terrain = snapshot.world.scene.terrain
    index = build_index(one_solid(BOX, np.random.default_rng(0)), terrain)
    rng = np.random.default_rng(2)
    angle, fall = rng.uniform(-0.5, 0.5, 200), rng.uniform(0.03, 0.5, 200)
    directions = np.stack([np.cos(angle), np.sin(angle), -fall], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.tile([3.0, 0.0, 0.0], (200, 1))
    hits = trace(index, origins, directions)
    assert (hits.solids == GROUND).mean() > 0.9
    for ray in np.flatnonzero(hits.solids == GROUND):
        before = np.arange(0.2, hits.distances[ray] - 0.6, 0.2)
        points = origins[ray] + before[:, None] * directions[ray]
        heights = np.array([terrain.height(*point[:2]) for point in points])
        assert (points[:, 2] > heights - 0.05).all()
        end = origins[ray] + hits.distances[ray] * directions[ray]
        assert abs(end[2] - terrain.height(*end[:2])) < KERB


def test_shadows_equal_traced_rays_to_the_sun(snapshot):
    view = snapshot.view(kitti_camera((40, 132)))
    met = np.flatnonzero(view.hits.solids != NOTHING)
    points = view.origins[met] + view.hits.distances[met, None] * view.directions[met]
    points = points + 0.05 * view.hits.normals[met]
    sun = np.array([0.4, 0.5, 0.77])
    sun /= np.linalg.norm(sun)
    shadow = lit(snapshot.index, points, sun) == 0
    towards = trace(
        snapshot.index, points, np.ascontiguousarray(np.broadcast_to(sun, points.shape))
    )
    blocked = (towards.solids != NOTHING) & (towards.distances < 44)
    assert 0.02 < shadow.mean() < 0.98
    assert (shadow == blocked).mean() > 0.999


def test_solids_outside_the_raster_are_ignored():
    solids = one_solid(BOX, np.random.default_rng(3))
    solids.geometry[0, :2] = 500.0, -500.0
    hits = trace(build_index(solids, flat_terrain()), *rays_at_origin(np.random.default_rng(0), 50))
    assert set(np.unique(hits.solids)) <= {NOTHING, GROUND}
