"""Colors, based on the palette of Okabe and Ito.

People with a color vision deficiency can distinguish them; they are darker, for contrast on a pale
ground, and shifted to remain distinct.
"""

Color = tuple[int, int, int]  #: red, green and blue, from 0 to 255

WHITE: Color = (255, 255, 255)
SKY: Color = (250, 251, 253)
GROUND: Color = (236, 239, 243)
GRID: Color = (206, 211, 218)
PALE: Color = (221, 221, 221)
GREY: Color = (118, 118, 118)
INK: Color = (34, 34, 34)
BLUE: Color = (0, 95, 165)
LIGHT_BLUE: Color = (86, 180, 233)
VERMILLION: Color = (198, 81, 0)
GREEN: Color = (0, 145, 80)
PURPLE: Color = (190, 90, 150)
PALE_PURPLE: Color = (218, 176, 204)
