"""Names of the patterns that cloth can have. The renderer draws them."""

from enum import StrEnum


class Texture(StrEnum):
    """Procedural cloth textures. Their order gives the codes of the label `texture`: add new ones at the end."""

    checker = "checker"
    dots = "dots"
    stripes = "stripes"
    plaid = "plaid"
    gingham = "gingham"
    herringbone = "herringbone"
    houndstooth = "houndstooth"
    floral = "floral"
    argyle = "argyle"
    camouflage = "camouflage"
    chevron = "chevron"
    terrazzo = "terrazzo"


HELD_OUT_TEXTURES = (Texture.argyle, Texture.camouflage, Texture.chevron, Texture.terrazzo)
"""To test with: a network that is to cope with a new texture is not trained with these [thesis, 4.5.1]."""
