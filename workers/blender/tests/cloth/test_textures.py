"""Textures: eight different pictures, drawn the same each time."""

import numpy as np
import pytest
from stickslip_blender.cloth.textures import SIZE, texture_image
from stickslip_schemas.spec.names import Texture


@pytest.mark.parametrize("texture", list(Texture))
def test_a_texture_is_a_picture_with_contrast(texture: Texture) -> None:
    picture = texture_image(texture)
    assert picture.shape == (SIZE, SIZE, 3)
    assert picture.dtype == np.uint8
    light = picture.astype(float).mean(axis=2)
    assert np.ptp(light) > 80
    assert light.std() > 20
    # At 224 x 224 a cloth is some 70 pixels wide: most of the pattern remains.
    coarse = light.reshape(64, SIZE // 64, 64, SIZE // 64).mean(axis=(1, 3))
    assert coarse.std() > 0.6 * light.std()


def test_no_two_are_alike_and_each_is_drawn_the_same_again() -> None:
    pictures = {texture: texture_image(texture) for texture in Texture}
    assert len({picture.tobytes() for picture in pictures.values()}) == len(Texture)
    assert np.array_equal(texture_image(Texture.floral), pictures[Texture.floral])


def test_a_checker_has_four_by_four_pairs_of_fields() -> None:
    picture = texture_image(Texture.checker)[..., 0]
    row = picture[SIZE // 16] > 128
    assert np.count_nonzero(row[1:] != row[:-1]) == 7
    assert (picture[SIZE // 16] > 128).tolist() == (picture[SIZE // 16 + SIZE // 4] > 128).tolist()
    assert (picture[SIZE // 16] > 128).tolist() == (picture[SIZE // 16 + SIZE // 8] <= 128).tolist()
