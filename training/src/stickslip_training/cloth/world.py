"""What stands about the cloth in a picture: a floor, shadows, clamps, hands and sticks that hold, and a camera.

All of it is drawn afresh for every picture that a network trains on. The cloth is rendered from a mesh, or is that of a
clip over a dark floor, whose silhouette is known. With alpha the coverage by cloth, c the light that cloth sends, f the
light of the floor, and e the exposure,

    picture = (e (alpha c + (1 - alpha) f))^gamma

and then what stands before the cloth covers it.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch.nn import functional

from stickslip_training.cloth.crop import ANCHOR, HEIGHT, PATCH, SCALE, WIDTH, Cameras, Crops, holder_path

if TYPE_CHECKING:
    from stickslip_training.cloth.render import Style

RANGES = {
    # The camera: what its calibration is off.
    "zoom": (0.97, 1.03),
    "roll": (-1.5, 1.5),  # [degree]
    "slip": (0.0, 2.0),  # of a clip's crop, along a row and a column [px]
    # The floor.
    "albedo": (0.05, 0.85),
    "dark": (0.02, 0.8),  # albedo of four floors of ten, evenly spread over the logarithm
    "contrast": (0.0, 0.45),  # of its pattern; half of the floors have a quarter of it, or less
    "heading": (0.0, 2 * math.pi),  # of its pattern [rad]
    "span": (0.35, 0.9),  # of its pattern [m]
    "haze": (0.0, 0.05),  # gloss
    "falloff": (-0.004, 0.004),  # of light over the picture, along a row [1/px]
    "falloff_down": (-0.004, 0.004),
    # Shadows: of the cloth on the floor; between both; and of what stands outside, which stays in the picture.
    "shadow": (0.2, 1.0),
    "shadow_blur": (0.4, 3.0),  # [px]
    "crevice": (0.0, 0.6),
    "crevice_blur": (2.0, 4.0),  # [px]
    "cast": (0.1, 0.6),
    "cast_heading": (0.0, 2 * math.pi),  # [rad]
    "cast_place": (-60.0, 60.0),  # from the middle of the picture [px]
    "cast_blur": (2.0, 12.0),  # [px]
    # Clamps at both held patches: half their size [m], and how bright they are above and below.
    "clamp_wide": (0.003, 0.011),
    "clamp_high": (0.003, 0.010),
    "clamp_upper": (0.02, 0.6),
    "clamp_lower": (0.02, 0.3),
    # Hands: an ellipse and an arm that leans [m].
    "hand_wide": (0.010, 0.022),
    "hand_up": (0.012, 0.03),
    "hand_high": (0.014, 0.028),
    "arm_lean": (-0.6, 0.6),
    "arm_wide": (0.008, 0.02),
    "arm_up": (0.015, 0.03),
    "skin": (0.08, 0.75),
    # A stick over each holder: half its width [m].
    "stick": (0.001, 0.0035),
    "stick_light": (0.01, 0.4),
    # The codec: the step of the coefficients of 8 x 8 pixels of the highest frequency.
    "codec": (0.0, 0.12),
}
"""What numbers of a world are drawn from, evenly."""

CHANCES = {"tame": 0.25, "matt": 0.15, "dim": 0.4, "cast": 0.6, "clamp": 0.5, "hands": 0.35, "stick": 0.6, "codec": 0.5}
"""Of a camera without errors, of the dark floor of `Style`, of an albedo from `dark`, and of the things themselves."""

PATTERN = 96
"""Texels along a side of the pattern of a floor."""

_EXPOSED = 0.97  # share of the pixels of a clip that are not saturated
_EDGE = 2 * SCALE  # how sharp edges of clamps and hands are [1/m]


@dataclass(frozen=True)
class World:
    """What stands about the cloth of some clips."""

    drawn: dict[str, torch.Tensor]
    """(B,): numbers of `RANGES`."""
    there: dict[str, torch.Tensor]
    """(B,): 1 where one of `CHANCES` came, 0 elsewhere."""
    pattern: torch.Tensor
    """(B, PATTERN, PATTERN): of the floor, about -1 to 1."""

    def __getitem__(self, name: str) -> torch.Tensor:
        """Return a number of each clip, shaped to multiply pictures (B, F, H, W)."""
        return self.drawn[name][:, None, None, None]

    def is_there(self, name: str) -> torch.Tensor:
        """Return 1 or 0 for each clip, shaped to multiply pictures."""
        return self.there[name][:, None, None, None]

    def seen_by(self, cameras: Cameras) -> Cameras:
        """Return the true cameras of clips that are registered as by `cameras`."""
        roll = torch.deg2rad(self.drawn["roll"])
        c, s, zero, one = torch.cos(roll), torch.sin(roll), torch.zeros_like(roll), torch.ones_like(roll)
        turn = torch.stack([c, -s, zero, s, c, zero, zero, zero, one], dim=-1).reshape(-1, 3, 3)
        moved = (turn @ cameras.translation[..., None])[..., 0]
        return Cameras(turn @ cameras.rotation, moved, cameras.focal * self.drawn["zoom"][:, None], cameras.center)


def draw_world(clips: int, generator: torch.Generator) -> World:
    """Draw what stands about the cloth."""
    there = {name: (torch.rand(clips, generator=generator) < chance).float() for name, chance in CHANCES.items()}
    drawn = {n: low + (high - low) * torch.rand(clips, generator=generator) for n, (low, high) in RANGES.items()}
    low, high = (math.log(end) for end in RANGES["dark"])
    dim = torch.exp(low + (high - low) * torch.rand(clips, generator=generator))
    drawn["albedo"] = torch.where(there["dim"] > 0, dim, drawn["albedo"])
    drawn["contrast"] = drawn["contrast"] ** 2 / RANGES["contrast"][1]
    for name, exact in (("zoom", 1.0), ("roll", 0.0), ("slip", 0.0)):
        drawn[name] = torch.where(there["tame"] > 0, exact, drawn[name])
    return World(drawn, there, _patterns(clips, generator))


def _patterns(clips: int, generator: torch.Generator) -> torch.Tensor:
    """Draw floors: smooth or fine blots, wood (long in one direction), veins of marble, tiles or checks."""
    sort, heading, rough, size, tiled = torch.rand(5, clips, 1, 1, generator=generator)
    across = (heading[:, 0] < 0.5).long() == torch.arange(2)
    found = torch.zeros(clips, PATTERN, PATTERN)
    for octave, coarse in enumerate((4, 9, 20, 44)):
        cells = torch.where((sort[:, 0] < 0.4) & across, max(2, coarse // 6), coarse)
        noise = torch.randn(clips, coarse, coarse, generator=generator)
        found = found + (0.45 + 0.4 * rough) ** octave * enlarged(noise, cells, PATTERN)
    found = found / (found.std(dim=(1, 2), keepdim=True) + 1e-6)
    y, x = torch.meshgrid(torch.arange(PATTERN), torch.arange(PATTERN), indexing="ij")
    side = 6 + (20 * size).long()
    checks = torch.where((x // side + y // side) % 2 == 0, 1.0, -1.0)
    joints = -2.0 * ((x % side == 0) | (y % side == 0)).float()
    found = torch.where((sort >= 0.4) & (sort < 0.6), torch.sin(2.5 * found), found)
    found = torch.where(sort >= 0.9, 0.3 * found + torch.where(tiled < 0.5, checks, joints), found)
    return found.clamp(-2.5, 2.5)


def enlarged(noise: torch.Tensor, cells: torch.Tensor, points: int) -> torch.Tensor:
    """Enlarge the first `cells`, (B, 2) rows and columns, of noise (B, n, n) to (B, points, points), smoothly."""
    down, along = (torch.linspace(0, 2, points) * ((cells - 1) / (noise.shape[1] - 1))[..., None] - 1).unbind(1)
    grid = torch.stack([along[:, None].expand(-1, points, -1), down[..., None].expand(-1, -1, points)], dim=-1)
    return functional.grid_sample(noise[:, None], grid, mode="bicubic", padding_mode="border", align_corners=True)[:, 0]


@dataclass(frozen=True)
class Cloth:
    """Cloth in crops, (B, F, 72, 88) each."""

    alpha: torch.Tensor
    """Coverage, 0 to 1."""
    light: torch.Tensor
    """That the cloth sends to the camera, before exposure."""
    shadow: torch.Tensor
    """Share of the lamp that the cloth takes from the floor behind."""


def cloth_of_clip(
    crops: torch.Tensor, alpha: torch.Tensor, style: "Style", world: World, generator: torch.Generator
) -> tuple[Cloth, World, torch.Tensor]:
    """Return the cloth of clips, grey levels, with known coverage; the world around it; and its coverage.

    A floor with a mean light of 0.05 or more lights the cloth, and stays: all of the picture counts as cloth. A warp
    makes the errors of the camera; the world that is returned has none left.
    """
    frames = crops.shape[1]
    both = _warped(torch.cat([crops, alpha], dim=1), world, generator)
    linear, cover = both[:, :frames].clamp(1e-4, 1.0) ** 2.2, both[:, frames:].clamp(0.0, 1.0)
    gain = torch.exp(0.25 * torch.randn(len(crops), 1, 1, 1, generator=generator))
    floor = cover < 0.02
    dark = (linear * floor).sum(dim=(1, 2, 3), keepdim=True) < 0.05 * floor.sum(dim=(1, 2, 3), keepdim=True)
    alpha = torch.where(dark, cover, torch.ones_like(cover))
    light = linear * gain / alpha.clamp(min=0.05) * (alpha > 0.02) / style.exposure[:, None, None, None]
    down, along = torch.randint(-8, 9, (2,), generator=generator).tolist()
    cloth = Cloth(alpha, light.clamp(max=4.0), torch.roll(cover, (abs(down) // 2 + 1, along), (2, 3)))
    exact = {"zoom": torch.ones_like(world.drawn["zoom"]), "roll": torch.zeros_like(world.drawn["roll"])}
    return cloth, replace(world, drawn=world.drawn | exact), cover


def _warped(crops: torch.Tensor, world: World, generator: torch.Generator) -> torch.Tensor:
    """Zoom, roll and shift crops (B, F, 72, 88) about their middle; borders are repeated."""
    roll, slip = torch.deg2rad(world.drawn["roll"]), world.drawn["slip"][:, None]
    c, s = torch.cos(roll) / world.drawn["zoom"], torch.sin(roll) / world.drawn["zoom"]
    shift = slip * (2 * torch.rand(len(crops), 2, generator=generator) - 1)
    rows = [
        torch.stack([c, -s * HEIGHT / WIDTH, 2 * shift[:, 0] / WIDTH], dim=-1),
        torch.stack([s * WIDTH / HEIGHT, c, 2 * shift[:, 1] / HEIGHT], dim=-1),
    ]
    grid = functional.affine_grid(torch.stack(rows, dim=1), list(crops.shape), align_corners=False)
    return functional.grid_sample(crops, grid, mode="bilinear", padding_mode="border", align_corners=False)


def light_of(
    cloth: Cloth, cameras: Cameras, crops: Crops, instants: tuple[float, ...], style: "Style", world: World
) -> torch.Tensor:
    """Return the light of whole pictures, (B, F, 72, 88); `cameras` are the true ones, `crops` the registration."""
    exposure = style.exposure[:, None, None, None]
    pixels = _pixels(crops)
    middle = pixels - cameras.center[:, None, None, None]
    u, v = middle[..., 0], middle[..., 1]
    matt = world.is_there("matt")
    floor = matt * style.floor[:, None, None, None] + (1 - matt) * exposure * _floor(
        cloth, cameras, pixels, style, world
    ) * (1 + world["falloff"] * u + world["falloff_down"] * v).clamp(min=0.2)
    light = exposure * cloth.alpha * cloth.light + (1 - cloth.alpha) * floor
    heading = world["cast_heading"]
    beyond = u * torch.cos(heading) + v * torch.sin(heading) - world["cast_place"]
    light = light * (1 - world.is_there("cast") * world["cast"] * torch.sigmoid(beyond / world["cast_blur"]))
    light = _held(light, cameras, crops, instants, style, world)
    # A camera exposes so that hardly any pixel is saturated.
    brightest = light.flatten(1)[:, ::7].quantile(_EXPOSED, dim=1)[:, None, None, None]
    light = light / brightest.clamp(min=1.0)
    outside = (middle.abs() > cameras.center[:, None, None, None] + 0.5).any(dim=-1)
    return torch.where(outside, torch.zeros_like(light), light)


def _pixels(crops: Crops) -> torch.Tensor:
    """Return the pixel of the picture at each pixel of the crops, (B, F, 72, 88, 2)."""
    rows, columns = torch.meshgrid(torch.arange(float(HEIGHT)), torch.arange(float(WIDTH)), indexing="ij")
    off = torch.stack([columns - ANCHOR[1], rows - ANCHOR[0]], dim=-1)
    return off / crops.scale[..., None, None, None] + crops.origin[..., None, None, :]


def _floor(cloth: Cloth, cameras: Cameras, pixels: torch.Tensor, style: "Style", world: World) -> torch.Tensor:
    """Return the light of the floor, before exposure."""
    ray = (pixels - cameras.center[:, None, None, None]) / cameras.focal[:, None, None, None]
    ray = torch.cat([ray, torch.ones_like(ray[..., :1])], dim=-1)
    eye = -(cameras.rotation.transpose(1, 2) @ cameras.translation[..., None])[..., 0]
    aim = torch.einsum("bij,bfhwi->bfhwj", cameras.rotation, ray)  # R^T ray
    far = -eye[:, 2].reshape(-1, 1, 1, 1) / aim[..., 2].clamp(max=-1e-3)
    place = eye[:, None, None, None, :2] + far[..., None] * aim[..., :2]
    c, s = torch.cos(world["heading"]), torch.sin(world["heading"])
    x, y = place[..., 0] - 0.15, place[..., 1]  # from the middle of the drag
    grid = torch.stack([c * x - s * y, s * x + c * y], dim=-1) / world["span"][..., None]
    pattern = functional.grid_sample(
        world.pattern[:, None], grid.flatten(1, 2), mode="bilinear", padding_mode="reflection", align_corners=True
    ).reshape(cloth.alpha.shape)
    shadow = world["shadow"] * blurred(cloth.shadow, world.drawn["shadow_blur"])
    crevice = world["crevice"] * blurred(cloth.alpha, world.drawn["crevice_blur"])
    light = style.ambient[:, None, None, None] * (1 - crevice) + style.lamp[:, 2][:, None, None, None] * (1 - shadow)
    return world["albedo"] * (1 + world["contrast"] * pattern) * light + world["haze"]


def blurred(pictures: torch.Tensor, deviation: torch.Tensor) -> torch.Tensor:
    """Blur pictures (B, F, H, W), each clip by its own Gaussian of at most 4 px or so."""
    x = torch.arange(-6.0, 7.0)
    kernel = torch.exp(-0.5 * (x / deviation.clamp(min=1e-2)[:, None]) ** 2)
    kernel = kernel / kernel.sum(dim=1, keepdim=True)
    flat, clips = pictures.transpose(0, 1), len(pictures)
    for shape, padding in (((clips, 1, 13, 1), (0, 0, 6, 6)), ((clips, 1, 1, 13), (6, 6, 0, 0))):
        padded = functional.pad(flat, padding, mode="replicate")
        flat = functional.conv2d(padded, kernel.reshape(shape), groups=clips)
    return flat.transpose(0, 1)


def _held(
    light: torch.Tensor, cameras: Cameras, crops: Crops, instants: tuple[float, ...], style: "Style", world: World
) -> torch.Tensor:
    """Return pictures with what holds the cloth at its two held patches."""
    x, z = holder_path(instants)
    ends = torch.stack([torch.stack([x, torch.full_like(x, y), z], dim=-1) for y in (-PATCH, PATCH)], dim=1)
    pixels, depth = cameras.project(ends.expand(len(light), -1, -1, -1))
    place = crops.off_by(style.shift, style.stretch).of_pixels(pixels)
    scale = crops.scale[..., None] * cameras.focal.mean(dim=1)[:, None, None] / depth  # [px/m]
    rows, columns = torch.meshgrid(torch.arange(float(HEIGHT)), torch.arange(float(WIDTH)), indexing="ij")

    def covered(inside: torch.Tensor, name: str, brightness: torch.Tensor) -> torch.Tensor:
        share = torch.sigmoid(_EDGE * inside) * world.is_there(name)
        return (1 - share) * light + share * brightness

    exposure = style.exposure[:, None, None, None].clamp(0.7, 1.3)
    for side in range(2):
        across = (columns - place[:, :, side, 0, None, None]) / scale[:, :, side, None, None]
        down = (rows - place[:, :, side, 1, None, None]) / scale[:, :, side, None, None]
        clamp = torch.minimum(world["clamp_wide"] - across.abs(), world["clamp_high"] - down.abs())
        upper = down < -0.6 * world["clamp_high"]
        light = covered(clamp, "clamp", torch.where(upper, world["clamp_upper"], world["clamp_lower"]))
        palm = (across / world["hand_wide"]) ** 2 + ((down + world["hand_up"]) / world["hand_high"]) ** 2
        beside = (across + world["arm_lean"] * down).abs()
        arm = torch.minimum(world["arm_wide"] - beside, -world["arm_up"] - down)
        light = covered(torch.maximum(0.015 * (1 - palm.sqrt()), arm), "hands", world["skin"] * exposure)
        stick = torch.minimum(world["stick"] - across.abs(), -0.002 - down)
        light = covered(stick, "stick", world["stick_light"])
    return light


def coded(pictures: torch.Tensor, world: World) -> torch.Tensor:
    """Return pictures (B, F, H, W) as a lossy codec keeps them: coefficients of 8 x 8 pixels in whole steps."""
    n = torch.arange(8.0)
    basis = torch.cos(math.pi / 8 * (n + 0.5) * n[:, None]) * torch.where(n == 0, 0.5, math.sqrt(0.5))[:, None] / 2**0.5
    clips, frames, height, width = pictures.shape
    blocks = pictures.reshape(clips, frames, height // 8, 8, width // 8, 8).transpose(3, 4)
    found = basis @ blocks @ basis.T
    step = world["codec"][..., None, None] * (0.1 + (n + n[:, None]) / 14)
    kept = basis.T @ ((found / step.clamp(min=1e-6)).round() * step.clamp(min=1e-6)) @ basis
    return torch.where(world.is_there("codec") > 0, kept.transpose(3, 4).reshape(pictures.shape), pictures)
