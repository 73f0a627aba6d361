"""Procedural textures of the objects in the demo scene: wood, bricks, house fronts, a map, a sky."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter, ImageFont
from scipy.ndimage import gaussian_filter

Picture = NDArray[np.float64]
Color = tuple[int, int, int]

CREAM, INK, GOLD, RED = (236, 226, 200), (28, 26, 30), (214, 170, 82), (176, 46, 40)
SERIF = "DejaVuSerif-Bold.ttf"


def noise(size: tuple[int, int], sigma: tuple[float, float], seed: int) -> Picture:
    """Smooth tileable noise [H, W] of mean 0 and standard deviation 1."""
    field = np.random.default_rng(seed).normal(size=size[::-1])
    smooth = gaussian_filter(field, sigma[::-1], mode="wrap")
    return (smooth - smooth.mean()) / smooth.std()


def clouds(size: tuple[int, int], seed: int, octaves: int = 5, base: float = 0.12) -> Picture:
    """Fractal noise [H, W] of several octaves."""
    total = sum(0.55**k * noise(size, (base * size[1] / 2**k,) * 2, seed + k) for k in range(octaves))
    return (total - total.mean()) / total.std()


def grained(color: Color, size: tuple[int, int], seed: int, amount: float = 0.07) -> Picture:
    """A uniform colour with some grain, sRGB [H, W, 3] in [0, 1]."""
    grain = clouds(size, seed, 6, 0.06)[..., None] * amount
    return np.clip(np.array(color) / 255 * (1 + grain), 0, 1)


def drawn(base: Picture, draw: Callable[[ImageDraw.ImageDraw], object], blur: float = 0.0) -> Picture:
    """An image with a drawing on it; the grain below is preserved."""
    flat = Image.new("RGBA", (base.shape[1], base.shape[0]), (0, 0, 0, 0))
    draw(ImageDraw.Draw(flat))
    if blur:
        flat = flat.filter(ImageFilter.GaussianBlur(blur))
    over = np.array(flat) / 255.0
    relative = base / np.maximum(base.mean(axis=(0, 1), keepdims=True), 1e-3)
    return np.clip(base + over[..., 3:] * (over[..., :3] * (0.5 + 0.5 * relative) - base), 0, 1)


def font(size: int) -> ImageFont.FreeTypeFont:
    """A free font that is installed on most systems."""
    return ImageFont.truetype(SERIF, size)


def wood(color: Color, seed: int, size: tuple[int, int] = (512, 512)) -> Picture:
    """Wood whose grain runs along x."""
    grain = noise(size, (60, 1.2), seed) * 0.09 + noise(size, (120, 6), seed + 1) * 0.12
    return np.clip(np.array(color) / 255 * (1 + grain[..., None]), 0, 1)


def planks(color: Color, seed: int, rows: int = 6) -> Picture:
    """Boards with dark joints."""
    picture = wood(color, seed, (768, 768))
    height = 768 // rows
    tones = np.random.default_rng(seed).uniform(0.8, 1.2, rows)
    for row in range(rows):
        picture[row * height : (row + 1) * height] *= tones[row]
        picture[row * height : row * height + 5] *= 0.35
    return np.clip(picture, 0, 1)


def bricks(color: Color, seed: int) -> Picture:
    """Bricks of 16 rows and 8 columns, each in its own tone."""
    picture, generator = grained((190, 180, 165), (1024, 1024), seed), np.random.default_rng(seed)
    for row in range(16):
        for column in range(8):
            x = column * 128 + (row % 2) * 64
            tone = np.array(color) / 255 * generator.uniform(0.7, 1.25) * generator.uniform(0.93, 1.07, 3)
            rows, columns = slice(row * 64 + 4, row * 64 + 60), np.arange(x + 4, x + 124) % 1024
            grain = picture[rows][:, columns].mean(axis=2, keepdims=True) / 0.7
            picture[rows, columns] = np.clip(tone * grain**2, 0, 1)
    return picture


def paving(seed: int) -> Picture:
    """Stone slabs."""
    picture, generator = grained((168, 160, 150), (1024, 1024), seed, 0.12), np.random.default_rng(seed)
    for row in range(4):
        for column in range(4):
            x = (column * 256 + (row % 2) * 128 + np.arange(256)) % 1024
            picture[row * 256 : row * 256 + 256, x] *= generator.uniform(0.75, 1.15)
        picture[row * 256 : row * 256 + 6] *= 0.5
    for row in range(4):
        for column in range(4):
            x = (column * 256 + (row % 2) * 128 + np.arange(6)) % 1024
            picture[row * 256 : row * 256 + 256, x] *= 0.5
    return np.clip(picture, 0, 1)


def road(seed: int) -> Picture:
    """Asphalt with a dashed line along x; 8 m by 4 m."""
    base = grained((92, 92, 98), (1024, 512), seed, 0.2)
    return drawn(
        base, lambda d: [d.rectangle((x, 244, x + 130, 268), (225, 222, 210, 235)) for x in range(60, 1024, 256)]
    )


def wallpaper(ground: Color, ink: Color, seed: int) -> Picture:
    """A pattern of leaves on a wall."""

    def leaves(d: ImageDraw.ImageDraw) -> None:
        for row in range(8):
            for column in range(8):
                x, y = column * 64 + 32 * (row % 2), row * 64
                for turn in range(6):
                    angle = turn * math.pi / 3
                    a, b = x + 13 * math.cos(angle), y + 13 * math.sin(angle)
                    d.ellipse((a - 8, b - 8, a + 8, b + 8), (*ink, 190))
                d.ellipse((x - 5, y - 5, x + 5, y + 5), (*GOLD, 230))

    return drawn(grained(ground, (512, 512), seed), leaves)


def house(color: Color, seed: int, *, shutters: Color, ground: str) -> Picture:
    """The front of a house of three storeys, 5 m by 9 m."""
    generator = np.random.default_rng(seed)

    def window(d: ImageDraw.ImageDraw, x: int, y: int) -> None:
        lit = generator.random() < 0.3
        glass, curtain = ((252, 214, 140), (250, 236, 204)) if lit else ((62, 78, 98), (176, 182, 190))
        d.rectangle((x - 14, y - 14, x + 114, y + 184), (232, 226, 214, 255))
        d.rectangle((x, y, x + 100, y + 170), (*glass, 255))
        d.polygon([(x, y), (x + 46, y), (x, y + 130)], (*curtain, 255))
        d.polygon([(x + 100, y), (x + 54, y), (x + 100, y + 130)], (*curtain, 255))
        for bar in ((x + 46, y, x + 54, y + 170), (x, y + 76, x + 100, y + 84)):
            d.rectangle(bar, (240, 236, 226, 255))
        for side in (x - 76, x + 116):
            d.rectangle((side, y - 8, side + 60, y + 178), (*shutters, 255))
            for slat in range(y + 4, y + 170, 14):
                d.line((side + 6, slat, side + 54, slat), tuple(int(0.6 * c) for c in shutters), 4)

    def front(d: ImageDraw.ImageDraw) -> None:
        for y in (150, 560):
            for x in (130, 420, 710):
                window(d, x, y)
        for ledge in ((0, 930, 1000, 960), (0, 40, 1000, 80)):
            d.rectangle(ledge, (*(min(int(1.25 * c), 255) for c in color), 255))
        if ground == "door":
            for x in (130, 710):
                window(d, x, 1100)
            d.rectangle((400, 1080, 580, 1560), (*shutters, 255))
            for x in (425, 500):
                for y in (1110, 1330):
                    d.rectangle((x, y, x + 55, y + 190), tuple(int(0.7 * c) for c in shutters))
            d.ellipse((548, 1305, 566, 1323), GOLD)
        else:
            d.rectangle((60, 1140, 940, 1560), (44, 40, 44, 255))
            for x in (90, 390, 690):
                d.rectangle((x, 1170, x + 240, 1480), (250, 208, 128, 255))
                for shelf in (1260, 1360):
                    d.rectangle((x, shelf, x + 240, shelf + 8), (120, 84, 52, 255))
                    for thing in range(x + 10, x + 220, 34):
                        top = shelf - int(generator.integers(24, 70))
                        d.rectangle(
                            (thing, top, thing + 22, shelf), tuple(int(c) for c in generator.integers(40, 220, 3))
                        )
            d.rectangle((60, 1000, 940, 1110), (*shutters, 255))
            d.text((500, 1055), ground, CREAM, font(84), anchor="mm")

    return drawn(grained(color, (1000, 1600), seed, 0.05), front)


def stripes(first: Color, second: Color, seed: int) -> Picture:
    """Cloth in two colours."""
    base = grained(first, (512, 256), seed, 0.04)
    return drawn(base, lambda d: [d.rectangle((x, 0, x + 31, 256), (*second, 255)) for x in range(0, 512, 64)])


def lettering(text: str, ground: Color, ink: Color, size: tuple[int, int], letters: int) -> Picture:
    """A board with a line of text and a rim."""
    width, height = size

    def board(d: ImageDraw.ImageDraw) -> None:
        d.rectangle((10, 10, width - 10, height - 10), outline=(*ink, 255), width=6)
        d.text((width / 2, height / 2), text, (*ink, 255), font(letters), anchor="mm")

    return drawn(grained(ground, size, 7, 0.05), board)


def globe() -> Picture:
    """An invented globe: sea, land, ice and lines of latitude; x spans one revolution."""
    size = (1024, 512)
    height = clouds(size, 12, 6, 0.13)
    latitude = np.abs(np.linspace(-1, 1, size[1]))[:, None]
    land = height > 0.25
    picture = np.where(land[..., None], [0.72, 0.62, 0.36], [0.10, 0.36, 0.52])
    picture[land & (height > 0.9)] = [0.45, 0.52, 0.25]
    picture[land & (height > 1.6)] = [0.55, 0.38, 0.22]
    picture[(latitude + 0.08 * height) > 0.88] = [0.93, 0.94, 0.95]
    picture[np.abs(height - 0.25) < 0.05] = [0.93, 0.90, 0.76]
    picture = np.clip(picture * (1 + 0.06 * noise(size, (2, 2), 5)[..., None]), 0, 1)

    def lines(d: ImageDraw.ImageDraw) -> None:
        for y in range(64, 512, 64):
            d.line((0, y, 1024, y), (250, 240, 210, 110), 2)
        for x in range(0, 1024, 64):
            d.line((x, 0, x, 512), (250, 240, 210, 110), 2)
        d.line((0, 256, 1024, 256), (176, 46, 40, 220), 4)

    return drawn(picture, lines)


def porcelain() -> Picture:
    """White with blue flowers and rims."""
    blue = (34, 66, 150)

    def flowers(d: ImageDraw.ImageDraw) -> None:
        for x in range(64, 1024, 128):
            for turn in range(7):
                a = turn * 2 * math.pi / 7
                px, py = x + 26 * math.cos(a), 256 + 26 * math.sin(a)
                d.ellipse((px - 15, py - 15, px + 15, py + 15), (*blue, 255))
            d.ellipse((x - 12, 244, x + 12, 268), (238, 196, 80, 255))
            d.arc((x - 70, 170, x + 6, 340), 20, 150, (*blue, 255), 7)
            d.arc((x - 6, 170, x + 70, 340), 200, 330, (*blue, 255), 7)
        for y in (40, 62, 440, 462):
            d.rectangle((0, y, 1024, y + 10), (*blue, 255))

    return drawn(grained((238, 238, 234), (1024, 512), 3, 0.02), flowers)


def amphora() -> Picture:
    """Terracotta with black bands, a meander and runners' dots."""

    def bands(d: ImageDraw.ImageDraw) -> None:
        for y in (60, 200, 330, 460):
            d.rectangle((0, y, 1024, y + 18), (*INK, 255))
        for x in range(0, 1024, 64):
            for top, key in ((90, 1), (360, -1)):
                y = top
                points = [(x, y + 80), (x, y), (x + 48, y), (x + 48, y + 56), (x + 24, y + 56), (x + 24, y + 30)]
                d.line([(x + (px - x) * key % 64 if key < 0 else px, py) for px, py in points], (*INK, 255), 8)
            d.polygon([(x + 32, 228), (x + 60, 316), (x + 4, 316)], (*INK, 255))

    return drawn(grained((196, 98, 52), (1024, 512), 9, 0.06), bands)


def clock() -> Picture:
    """A clock's face, ten past ten."""

    def face(d: ImageDraw.ImageDraw) -> None:
        d.ellipse((6, 6, 506, 506), (*GOLD, 255))
        d.ellipse((26, 26, 486, 486), (246, 242, 228, 255))
        for hour in range(12):
            a = hour * math.pi / 6 - math.pi / 3
            name = ["I", "II", "III", "IV", "V", "VI", "VII", "VIII", "IX", "X", "XI", "XII"][hour]
            d.text((256 + 182 * math.cos(a), 256 + 182 * math.sin(a)), name, (*INK, 255), font(44), anchor="mm")
        for turn, length, width in ((-2.62 - 0.0, 110, 18), (-0.52, 165, 10)):
            d.line((256, 256, 256 + length * math.cos(turn), 256 + length * math.sin(turn)), (*INK, 255), width)
        d.ellipse((238, 238, 274, 274), (*INK, 255))

    return drawn(grained((112, 58, 34), (512, 512), 2, 0.08), face)


def landscape(seed: int) -> Picture:
    """A painting: hills in front of an evening sky, with a lake."""
    y = np.linspace(0, 1, 384)[:, None, None]
    picture = np.broadcast_to(
        (1 - y) * np.array([0.25, 0.35, 0.62]) + y * np.array([1.0, 0.62, 0.30]), (384, 512, 3)
    ).copy()
    glow = np.hypot(*np.meshgrid((np.arange(512) - 340) / 50, (np.arange(384) - 190) / 50))
    picture += np.exp(-(glow**2))[..., None] * np.array([0.5, 0.4, 0.2])
    for layer, (top, color) in enumerate(((190, (90, 84, 120)), (235, (64, 80, 76)), (285, (40, 60, 40)))):
        ridge = top + 26 * noise((512, 8), (30 - 6 * layer, 1), seed + layer)[0]
        picture[np.arange(384)[:, None] > ridge[None]] = np.array(color) / 255
    picture[320:] = picture[320:200:-1][: 384 - 320] * 0.8
    return np.clip(picture * (1 + 0.06 * noise((512, 384), (3, 1), seed)[..., None]), 0, 1)


def squares(seed: int) -> Picture:
    """A painting of coloured rectangles between black bars."""
    generator = np.random.default_rng(seed)
    colors = [(214, 40, 40), (246, 196, 52), (36, 74, 160), (240, 236, 222), (240, 236, 222)]

    def boxes(d: ImageDraw.ImageDraw) -> None:
        xs, ys = [0, 120, 190, 360, 400], [0, 90, 250, 330, 400]
        for left, right in pairwise(xs):
            for top, bottom in pairwise(ys):
                d.rectangle((left, top, right, bottom), colors[generator.integers(5)], (20, 20, 20), 7)

    return drawn(grained((240, 236, 222), (400, 400), seed, 0.03), boxes)


def spines(seed: int) -> Picture:
    """The spines of twelve books."""
    generator = np.random.default_rng(seed)
    colors = [(120, 32, 36), (28, 66, 92), (60, 84, 50), (150, 110, 50), (70, 46, 84), (190, 170, 130), (30, 30, 36)]
    titles = ("OPTICS", "FRESNEL", "LIGHT", "PARIS", "ATLAS", "ALICE")
    titles += ("FAUST", "MIRRORS", "GLASS", "SEA", "EMMA", "MOON")

    def books(d: ImageDraw.ImageDraw) -> None:
        for x, word in zip(range(0, 768, 64), titles, strict=True):
            d.rectangle((x, 0, x + 61, 384), (*colors[generator.integers(7)], 255))
            for y in (30, 44, 330, 344):
                d.rectangle((x + 4, y, x + 58, y + 5), (*GOLD, 255))
            title = Image.new("RGBA", (260, 50), (0, 0, 0, 0))
            ImageDraw.Draw(title).text((130, 25), word, (*GOLD, 255), font(40), anchor="mm")
            d._image.paste(title.rotate(90, expand=True), (x + 6, 60), title.rotate(90, expand=True))

    return drawn(grained((60, 50, 44), (768, 384), seed, 0.08), books)


def chequers() -> Picture:
    """A chess board."""
    base = wood((222, 190, 140), 4, (512, 512))
    dark = wood((92, 56, 34), 5, (512, 512))
    odd = (np.arange(512)[:, None] // 64 + np.arange(512)[None] // 64) % 2 == 1
    return np.where(odd[..., None], dark, base)


def leaves(seed: int) -> Picture:
    """Foliage."""
    shade = clouds((512, 512), seed, 6, 0.05)
    picture = np.array([0.16, 0.30, 0.09]) * (1 + 0.5 * shade[..., None])
    return np.clip(picture + (noise((512, 512), (4, 4), seed + 9) > 1.3)[..., None] * [0.25, 0.22, 0.02], 0.01, 1)


def sky() -> Picture:
    """Linear radiance of an evening sky, as a panorama [H, W, 3]; the lower half is dim ground."""
    height, width = 256, 512
    elevation = np.linspace(math.pi / 2, -math.pi / 2, height)[:, None]
    up = np.clip(np.sin(elevation), 0, 1)[..., None]
    low, high = np.array([1.0, 0.72, 0.48]), np.array([0.16, 0.34, 0.72])
    colors = low * np.exp(-5 * up) + high * (1 - np.exp(-5 * up))
    cloud = clouds((width, height), 21, 5, 0.16)
    cover = np.clip((gaussian_filter(cloud, (1, 4), mode="wrap") - 0.35) * 0.9, 0, 0.85)[..., None] * np.clip(
        up * 6, 0, 1
    )
    colors = np.broadcast_to(colors, (height, width, 3)) * (1 - cover) + cover * np.array([1.15, 0.95, 0.86])
    return np.where(elevation[..., None] > 0, colors, np.array([0.10, 0.09, 0.08]))


def pictures() -> dict[str, Picture]:
    """All textures, sRGB in [0, 1]."""
    flat = {
        "white": (236, 234, 228),
        "tea": (120, 62, 24),
        "yellow": (246, 198, 40),
        "orange": (232, 110, 30),
        "ink": (34, 32, 36),
        "red": (178, 40, 36),
        "blue": (40, 84, 150),
        "brass": (206, 156, 66),
        "horn": (170, 112, 40),
        "gilt": (196, 150, 70),
        "green": (38, 84, 66),
        "darkgreen": (28, 64, 52),
        "cream": (232, 222, 200),
        "ceiling": (228, 222, 208),
        "panel": (120, 44, 40),
        "velvet": (110, 26, 40),
        "leather": (112, 60, 32),
        "bluebook": (36, 62, 104),
        "greenbook": (50, 84, 56),
        "paper": (226, 214, 184),
        "ivory": (232, 220, 190),
        "rubber": (36, 36, 38),
        "chrome": (190, 190, 196),
        "carpaint": (200, 40, 34),
        "carglass": (70, 92, 112),
        "headlight": (245, 240, 215),
        "kerb": (176, 168, 158),
        "record": (28, 28, 32),
        "vase": (52, 92, 110),
        "sail": (240, 232, 210),
    }
    painted = {name: grained(color, (256, 256), number, 0.05) for number, (name, color) in enumerate(flat.items())}
    painted |= {
        "planks": planks((150, 104, 66), 1), "walnut": wood((92, 58, 38), 2), "oak": wood((164, 122, 76), 3),
        "mahogany": wood((128, 62, 38), 4), "bark": wood((98, 76, 56), 5), "bricks": bricks((150, 74, 56), 6),
        "paving": paving(7), "road": road(8), "wallpaper": wallpaper((26, 66, 72), (48, 104, 102), 9),
        "awning": stripes((240, 234, 220), (186, 40, 38), 10), "globe": globe(), "porcelain": porcelain(),
        "amphora": amphora(), "clock": clock(), "landscape": landscape(3), "spines": spines(4),
        "chequers": chequers(), "leaves": leaves(11), "tiles": bricks((170, 84, 52), 12),
        "sign": lettering("GLASS & SPLAT  ·  CURIOSITIES", (28, 64, 52), (222, 182, 92), (2048, 205), 110),
        "postbox": lettering("POST", (190, 36, 34), (240, 226, 190), (256, 700), 64),
        "hull": stripes((30, 60, 110), (30, 60, 110), 13),
        "house1": house((232, 184, 116), 1, shutters=(58, 96, 84), ground="CAFÉ"),
        "house2": house((214, 122, 98), 2, shutters=(70, 64, 112), ground="door"),
        "house3": house((150, 180, 196), 3, shutters=(232, 228, 214), ground="BAKERY"),
        "house4": house((236, 224, 190), 4, shutters=(150, 56, 44), ground="door"),
        "window": house((150, 74, 56), 5, shutters=(58, 96, 84), ground="door")[130:360, 116:244],
        "door": lettering("14", (92, 40, 36), (190, 140, 70), (400, 860), 90),
    }  # fmt: skip
    return painted
