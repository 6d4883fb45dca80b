"""The oracle against scenes one can compute in the head, and against looking at single points."""

import math

import numpy as np
import pytest
import shapely

from tests.oracles.visibility import (
    Array,
    Prism,
    flat_share,
    prism,
    random_observer,
    random_scene,
    rectangle,
    surface_share,
)

HIGH = 1e6
EYE = (0.0, 0.0, 1.0)
# A box 10 m ahead: its nearest face is at x = 10, from y = −1 to 1, from the ground to 2 m.
AHEAD = rectangle(12.0, 0.0, 4.0, 2.0)
TARGET: Prism = (AHEAD, 0.0, 2.0)


def span(x0: float, x1: float, y0: float, y1: float) -> Array:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def both(others: list[Array], target: Array = AHEAD, eye: tuple[float, float] = (0.0, 0.0)) -> float:
    """`flat`, which must be `surface` with bodies without end."""
    flat = flat_share(eye, target, others)
    surface = surface_share((*eye, 1.0), (target, 0.0, 2.0), [(other, -HIGH, HIGH) for other in others])
    assert surface == pytest.approx(flat, abs=1e-3)
    return flat


# ------------------------------------------------------------------------------- in the plane


def test_nothing_else_and_bodies_behind_or_aside_hide_nothing():
    behind = span(14.5, 15.0, -20.0, 20.0)
    at_the_back = span(14.0, 15.0, -20.0, 20.0)
    beside = span(9.0, 12.0, 2.0, 3.0)
    behind_the_eye = span(-6.0, -5.0, -20.0, 20.0)
    assert both([]) == 1.0
    assert both([behind, at_the_back, beside, behind_the_eye]) == pytest.approx(1.0, abs=1e-9)


def test_a_wall_across_hides_all_and_half_a_wall_half():
    assert both([span(5.0, 5.1, -9.0, 9.0)]) == 0.0
    assert both([span(5.0, 5.1, 0.0, 9.0)]) == pytest.approx(0.5, abs=1e-9)
    # Twice the same half is still half.
    assert both([span(5.0, 5.1, 0.0, 9.0), span(3.0, 3.1, 0.0, 9.0)]) == pytest.approx(0.5, abs=1e-9)


def test_the_share_is_one_of_azimuth_not_of_width():
    # From −45° to 45°; the wall takes 22.5° to 45°, which is 29 % of the width of the face.
    wide = span(10.0, 12.0, -10.0, 10.0)
    wall = span(5.0, 5.1, 5.1 * math.tan(math.radians(22.5)), 9.0)
    assert both([wall], wide) == pytest.approx(0.75, abs=1e-9)


def test_a_target_across_the_cut_of_the_azimuth():
    behind = span(-14.0, -10.0, -1.0, 1.0)
    assert both([span(-5.1, -5.0, 0.0, 9.0)], behind) == pytest.approx(0.5, abs=1e-9)
    assert both([span(-5.1, -5.0, -9.0, 9.0)], behind) == 0.0
    assert both([span(5.0, 5.1, -9.0, 9.0)], behind) == 1.0


def test_touching_is_not_overlapping():
    in_front = span(9.0, 10.0, 0.0, 5.0)
    beside = span(10.0, 14.0, 1.0, 3.0)
    at_the_corner = span(9.0, 10.0, 1.0, 2.0)  # touches in one point; takes azimuths beyond the corner only
    rounding = span(9.0, 10.0 + 1e-12, 0.0, 5.0)
    assert both([in_front]) == pytest.approx(0.5, abs=1e-9)
    assert both([rounding]) == pytest.approx(0.5, abs=1e-9)
    assert both([beside, at_the_corner]) == pytest.approx(1.0, abs=1e-9)


def test_a_body_that_overlaps_the_target_does_not_hide_it():
    overlapping = span(5.0, 10.01, -5.0, 5.0)
    assert both([overlapping]) == 1.0
    assert both([overlapping, span(3.0, 3.1, 0.0, 9.0)]) == pytest.approx(0.5, abs=1e-9)


def test_inside_the_target_and_inside_another_body():
    around_the_eye = span(-1.0, 1.0, -1.0, 1.0)
    assert both([span(10.5, 11.0, -5.0, 5.0)], eye=(12.0, 0.0)) == 1.0
    assert both([span(9.0, 9.9, -5.0, 5.0)], eye=(10.0, 0.0)) == 1.0  # on the face itself
    assert both([around_the_eye]) == 1.0
    assert both([around_the_eye, span(5.0, 5.1, 0.0, 9.0)]) == pytest.approx(0.5, abs=1e-9)
    # Leaning against a wall from outside is not being inside it.
    assert both([span(0.0, 1.0, -5.0, 5.0)]) == 0.0
    assert both([span(-1.0, 0.0, -5.0, 5.0)]) == 1.0


def test_in_the_notch_of_an_l():
    # The observer at (0, 3) is within the convex hull of the L but not in the L.  Its one arm ends at (5, 0),
    # along the middle of a box that stands square to that line of sight.
    ell = np.array([[5.0, 0.0], [6.0, 0.0], [6.0, 8.0], [-8.0, 8.0], [-8.0, 7.0], [5.0, 7.0]])
    assert shapely.Polygon(ell).convex_hull.contains(shapely.Point(0.0, 3.0))
    yaw = math.atan2(-3.0, 5.0)
    target = rectangle(12.0 * math.cos(yaw), 3.0 + 12.0 * math.sin(yaw), 4.0, 2.0, yaw)
    assert both([ell], target, eye=(0.0, 3.0)) == pytest.approx(0.5, abs=1e-9)
    assert both([ell[::-1]], target, eye=(0.0, 3.0)) == pytest.approx(0.5, abs=1e-9)


def test_a_target_one_stands_in_the_notch_of_is_refused():
    ell = np.array([[5.0, 0.0], [6.0, 0.0], [6.0, 8.0], [-8.0, 8.0], [-8.0, 7.0], [5.0, 7.0]])
    with pytest.raises(ValueError, match="notch"):
        flat_share((0.0, 3.0), ell, [])
    with pytest.raises(ValueError, match="without height"):
        surface_share(EYE, (AHEAD, 1.0, 1.0), [])


def test_a_solid_hides_on_every_ray_on_which_it_begins_first():
    # It reaches .01 m into the target, along the whole of its face; of the upper half of the face; of none of it.
    def seen(solid: Array) -> float:
        flat = flat_share((0.0, 0.0), AHEAD, [], [solid])
        assert surface_share(EYE, TARGET, [], solids=[(solid, -HIGH, HIGH)]) == pytest.approx(flat, abs=1e-3)
        return flat

    assert seen(span(5.0, 10.01, -5.0, 5.0)) == 0.0
    assert seen(span(5.0, 10.01, 0.0, 5.0)) == pytest.approx(0.5, abs=1e-9)
    assert seen(span(10.01, 13.0, -5.0, 5.0)) == 1.0
    # The face of this one runs from (9.5, −1) to (10.5, 1): it crosses that of the target at (10, 0).
    assert seen(np.array([[9.5, -1.0], [20.0, -1.0], [20.0, 1.0], [10.5, 1.0]])) == pytest.approx(0.5, abs=0.01)


def test_a_body_under_the_eye_hides_what_is_below_its_far_edge():
    # From 6 m over a roof of 4 m that ends at 6 m: 6 − 2·10/6 = 2.667 m is the lowest one sees; at 5.5 m 2.364 m.
    roof = span(-6.0, 6.0, -9.0, 9.0)
    tall: Prism = (AHEAD, 0.0, 4.0)
    for given in ({"others": [(roof, 0.0, 4.0)]}, {"others": [], "solids": [(roof, 0.0, 4.0)]}):
        assert surface_share((0.0, 0.0, 6.0), tall, **given) == pytest.approx((4 - (6 - 20 / 6)) / 4, abs=1e-3)
        assert surface_share((0.0, 0.0, 3.9), tall, **given) == 1.0  # inside it: ignored
    # From 1 m under a deck of 2 m that ends at 5 m: 1 + 1·10/5 = 3 m is the highest one sees.
    deck = (span(-5.0, 5.0, -9.0, 9.0), 2.0, 3.0)
    assert surface_share((0.0, 0.0, 1.0), tall, [deck]) == pytest.approx(0.75, abs=1e-3)


# --------------------------------------------------------------------------------- with heights


@pytest.mark.parametrize(
    ("eye", "share"),
    [
        (1.0, 0.5),  # level with the top of the wall: hidden up to 1 m
        (2.0, 1.0),  # over the top the sight line comes down to the ground at the target
        (1.5, 0.75),  # 1.5 − .5·10/5 = .5 m is the lowest one sees
        (0.5, 0.25),  # .5 + .5·10/5 = 1.5 m
        (0.0, 0.0),
    ],
)
def test_over_a_low_wall(eye: float, share: float):
    wall = (span(5.0, 5.0 + 1e-6, -9.0, 9.0), 0.0, 1.0)
    assert surface_share((0.0, 0.0, eye), TARGET, [wall]) == pytest.approx(share, abs=1e-6)
    half = (span(5.0, 5.0 + 1e-6, 0.0, 9.0), 0.0, 1.0)
    assert surface_share((0.0, 0.0, eye), TARGET, [half]) == pytest.approx((1.0 + share) / 2.0, abs=1e-6)


def test_the_far_edge_of_a_roof_hides_more_than_its_near_edge():
    # From 4 m over a roof of 1 m that ends at 8 m: 4 − 3·10/8 = .25 m.
    roof = (span(3.0, 8.0, -9.0, 9.0), 0.0, 1.0)
    assert surface_share((0.0, 0.0, 4.0), TARGET, [roof]) == pytest.approx(0.875, abs=1e-9)


def test_a_block_against_the_face_hides_its_own_height_from_level():
    block = (span(9.0, 10.0, 0.0, 5.0), 0.0, 1.0)
    assert surface_share(EYE, TARGET, [block]) == pytest.approx(0.75, abs=1e-9)


def test_a_bridge_covers_from_above():
    # From below the deck: what rises above its bottom edge at 8 m, 1 + .4·10/8 = 1.5 m, is hidden.
    deck = (span(5.0, 8.0, -20.0, 20.0), 1.4, 2.4)
    assert surface_share(EYE, TARGET, [deck]) == pytest.approx(0.75, abs=1e-9)
    # From above: 6 − 3·10/8 = 2.25 m is the lowest one sees over it, and nothing passes beneath.
    deck = (span(5.0, 8.0, -20.0, 20.0), 2.0, 3.0)
    assert surface_share((0.0, 0.0, 6.0), (AHEAD, 0.0, 3.0), [deck]) == pytest.approx(0.25, abs=1e-9)
    # From above, over a deck one sees under as well: 6 − 3·10/8 = 2.25 up to 6 − 2·10/9 = 3.7778 is hidden.
    deck = (span(8.0, 9.0, -20.0, 20.0), 3.0, 4.0)
    hidden = (6.0 - 20.0 / 9.0) - 2.25
    assert surface_share((0.0, 0.0, 6.0), (AHEAD, 0.0, 4.0), [deck]) == pytest.approx(1 - hidden / 4, abs=1e-9)
    # Seen from above, a body over the target's own footprint is left out whatever its height.
    over = (span(9.0, 13.0, -20.0, 20.0), 1.0, 4.0)
    assert surface_share((0.0, 0.0, 6.0), TARGET, [over]) == 1.0


def test_covers_add_up_as_a_union():
    # Level view at 1 m: one wall hides 0 to 1 m, a board hides from 1 + (.75 − 1)·10/5 = .5 to 1.5 m.
    wall = (span(4.0, 4.0 + 1e-6, -9.0, 9.0), 0.0, 1.0)
    board = (span(5.0, 5.0 + 1e-6, -9.0, 9.0), 0.75, 1.25)
    assert surface_share(EYE, TARGET, [board]) == pytest.approx(0.5, abs=1e-6)
    assert surface_share(EYE, TARGET, [wall, board]) == pytest.approx(0.25, abs=1e-6)
    assert surface_share(EYE, TARGET, [board, wall, wall]) == pytest.approx(0.25, abs=1e-6)


def test_light_falls_through_the_notch_of_an_l():
    # Along the diagonal from (1.5, 8) the deck is met from 2 to 3 and from 3.5 to 4.5, the face at 10 (all
    # times √2).  A ray passes over the first part for z > 10 − 3.3/.3 = −1, and under the second for
    # z < 10 − 3.4/.35 = .2857.
    ell = np.array([[5.0, 0.0], [6.0, 0.0], [6.0, 6.0], [0.0, 6.0], [0.0, 5.0], [5.0, 5.0]])
    yaw, root = -math.pi / 4.0, math.sqrt(2.0)
    distance = 10.0 * root + 0.5
    narrow = rectangle(1.5 + distance / root, 8.0 - distance / root, 1.0, 0.01, yaw)
    share = surface_share((1.5, 8.0, 10.0), (narrow, 0.0, 1.0), [(ell, 6.6, 6.7)])
    assert share == pytest.approx(10.0 - 3.4 / 0.35, abs=1e-3)


# -------------------------------------------------------------------------------- random scenes


def share_by_points(
    observer: Array, target: Prism, others: list[Prism], azimuths: int, heights: int, steps: int
) -> float:
    """Looks at points: walks along each sight line and asks at every step whether that point is in a body."""
    here, eye = observer[:2], observer[2]
    shape = shapely.Polygon(target[0])
    middle = math.atan2(shape.centroid.y - here[1], shape.centroid.x - here[0])
    corners = np.asarray(target[0]) - here
    offsets = [math.remainder(math.atan2(y, x) - middle, 2.0 * math.pi) for x, y in corners]
    z = target[1] + (target[2] - target[1]) * (np.arange(heights) + 0.5) / heights
    fraction = (np.arange(steps) + 0.5) / steps
    seen = 0
    for k in range(azimuths):
        azimuth = middle + min(offsets) + (max(offsets) - min(offsets)) * (k + 0.5) / azimuths
        way = np.array([math.cos(azimuth), math.sin(azimuth)])
        ray = shapely.LineString([here, here + 500.0 * way])
        reach = shapely.Point(here).distance(ray.intersection(shape))
        x, y = here[:, None] + way[:, None] * reach * fraction
        hidden = np.zeros(heights, dtype=bool)
        for polygon, bottom, top in others:
            inside = shapely.contains_xy(shapely.Polygon(polygon), x, y)
            part = eye + (z[:, None] - eye) * fraction[inside]
            hidden |= ((part >= bottom) & (part <= top)).any(axis=1)
        seen += int((~hidden).sum())
    return seen / (azimuths * heights)


@pytest.mark.parametrize("height", [0.6, 1.7, 4.5, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_random_scenes(seed: int, height: float):
    rng = np.random.default_rng([seed, round(10 * height)])
    bodies = random_scene(rng)
    observer = random_observer(rng, bodies, height)
    shapes = [shapely.Polygon(body["polygon"]) for body in bodies]
    assert len(bodies) == 14
    assert [body["static"] for body in bodies] == [False] * 12 + [True] * 2
    assert all(shape.is_valid and shape.area > 0.2 for shape in shapes)
    assert all(a.distance(b) > 0.05 for i, a in enumerate(shapes) for b in shapes[:i])
    assert not any(shape.intersects(shapely.Point(observer[:2])) for shape in shapes)
    assert np.linalg.norm(observer[:2]) <= 40.0

    for number in range(0, 12, 2):
        target = prism(bodies[number])
        others = [prism(body) for k, body in enumerate(bodies) if k != number]
        # The deck of a bridge, which no body of the scene is.
        others.append((rectangle(*rng.uniform(-20.0, 20.0, 2), 12.0, 3.0, rng.uniform(0.0, 3.0)), 1.2, 1.8))
        flat = flat_share(observer[:2], target[0], [other for other, _, _ in others])
        endless = surface_share(observer, target, [(other, -HIGH, HIGH) for other, _, _ in others])
        surface = surface_share(observer, target, others)
        assert endless == pytest.approx(flat, abs=1.5e-3)
        assert 0.0 <= flat <= 1.0
        assert surface >= endless - 1e-9
        assert surface <= 1.0

        # The bodies that must not count are dropped by hand: the walk along the rays does not know the rule.
        area = shapely.Polygon(target[0])
        counted = [
            other
            for other in others
            if shapely.Polygon(other[0]).intersection(area).area <= 1e-9
            and not shapely.Polygon(other[0]).contains(shapely.Point(observer[:2]))
        ]
        points = share_by_points(observer, target, counted, azimuths=25, heights=100, steps=10_000)
        # The same azimuths on both sides; what is left is the grain of the points: half a height, and corners
        # cut by less than a step (a few mm), each of which would be a whole column.
        assert surface_share(observer, target, others, azimuths=25) == pytest.approx(points, abs=6e-3)
