"""SdfGrid against closed forms and finite differences."""

import pytest
import torch

from flashdex.geometry.sdf import NO_OBJECT_DISTANCE, SdfGrid

HALF = torch.tensor([0.03, 0.04, 0.05], dtype=torch.float64)


def sphere(points):
    return points.norm(dim=-1) - 0.05


def box(points):
    over = points.abs() - HALF
    outside = over.clamp_min(0).norm(dim=-1)
    return outside + over.amax(dim=-1).clamp_max(0)


def plane(points):
    normal = torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    return points @ normal + 0.01


@pytest.fixture(scope="module")
def grid():
    """Sphere, box and plane, each on a cube of its own size, off-centre."""
    values, origins, spacings = [], [], []
    for field, side in ((sphere, 0.2), (box, 0.25), (plane, 0.3)):
        axis = torch.linspace(0, side, 65, dtype=torch.float64)
        origin = torch.tensor([-0.5, -0.48, -0.52], dtype=torch.float64) * side
        nodes = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
        values.append(field(nodes + origin))
        origins.append(origin)
        spacings.append(axis[1])
    return SdfGrid(torch.stack(values), torch.stack(origins), torch.stack(spacings))


def random_points(count, reach, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return (
        torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    ) * reach


@pytest.mark.parametrize(
    ("row", "field", "kink"),
    [(0, sphere, 0.0), (1, box, 0.5), (2, plane, 0.0)],
    ids=["sphere", "box", "plane"],
)
def test_distance_matches_closed_form(grid, row, field, kink):
    points = random_points(4000, 0.18)
    points = points[points.norm(dim=-1) > 0.02]
    index = torch.full(points.shape[:1], row)
    distance, _ = grid.query(points, index)
    error = (distance - field(points)).abs()
    # Trilinear error: spacing^2 / r for curvature 1/r (here r >= 2 cm), and a part of
    # the spacing where the field has a kink (the medial axis of the box).
    assert error.max() < 6e-4 + kink * grid.spacing[row]
    assert error.quantile(0.8) < 1e-4
    inside = field(points) < -1e-3
    assert (distance[inside] < 0).all()


def test_linear_field_is_exact(grid):
    points = random_points(500, 0.25)
    distance, gradient = grid.query(points, torch.tensor(2))
    torch.testing.assert_close(distance, plane(points), rtol=0, atol=1e-12)
    normal = torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    torch.testing.assert_close(gradient, normal.expand_as(points), rtol=0, atol=1e-9)


def test_gradient_matches_finite_differences_inside_and_outside(grid):
    points = torch.cat((random_points(300, 0.19), random_points(300, 0.8, seed=1)))
    index = torch.arange(600) % 3
    _, gradient = grid.query(points, index)
    eps, slopes = 1e-7, []
    for axis in torch.eye(3, dtype=torch.float64):
        ahead, _ = grid.query(points + eps * axis, index)
        behind, _ = grid.query(points - eps * axis, index)
        slopes.append((ahead - behind) / (2 * eps))
    numeric = torch.stack(slopes, dim=-1)
    numeric /= numeric.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(gradient, numeric, rtol=0, atol=1e-5)


def test_gradient_points_away_from_a_sphere(grid):
    points = random_points(500, 0.19)
    points = points[points.norm(dim=-1) > 0.02]
    _, gradient = grid.query(points, torch.tensor(0))
    cosine = (gradient * points).sum(-1) / points.norm(dim=-1)
    assert cosine.min() > 0.99


def test_outside_is_boundary_value_plus_distance_to_the_box(grid):
    point = torch.tensor([[0.3, 0.0, 0.0]], dtype=torch.float64)
    distance, gradient = grid.query(point)
    # The box of the sphere's grid ends at x = 0.1, where the sphere is 0.05 away.
    assert distance.item() == pytest.approx(0.05 + 0.2, abs=3e-5)
    torch.testing.assert_close(
        gradient, torch.tensor([[1.0, 0, 0]], dtype=torch.float64), rtol=0, atol=0.02
    )


def test_index_broadcasts_over_leading_axes(grid):
    points = random_points(12, 0.2).view(4, 3, 3)
    rows = torch.tensor([[0], [1], [2], [0]])
    distance, gradient = grid.query(points, rows)
    assert distance.shape == (4, 3)
    assert gradient.shape == (4, 3, 3)
    for i, row in enumerate(rows[:, 0]):
        torch.testing.assert_close(distance[i], grid.query(points[i], row)[0])


def test_empty_slot_is_far_with_no_direction(grid):
    points = random_points(2, 0.1)
    distance, gradient = grid.query(points, torch.tensor([-1, 0]))
    assert distance[0] == NO_OBJECT_DISTANCE
    assert (gradient[0] == 0).all()
    assert distance[1] != NO_OBJECT_DISTANCE


def test_buffers_stay_out_of_checkpoints(grid):
    assert grid.state_dict() == {}


def test_refuses_grids_of_unequal_sides():
    with pytest.raises(ValueError, match="num_objects, R, R, R"):
        SdfGrid(torch.zeros(1, 4, 4, 5), torch.zeros(1, 3), torch.ones(1))
    with pytest.raises(ValueError, match="origin"):
        SdfGrid(torch.zeros(2, 4, 4, 4), torch.zeros(1, 3), torch.ones(2))
