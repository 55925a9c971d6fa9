"""Shading of pictures: the sky, the lines of grounds, and the light that surfaces send back."""

import warp as wp

wp.set_module_options({"enable_backward": False})

HORIZON_COLOR = wp.constant(wp.vec3(0.76, 0.80, 0.84))
ZENITH_COLOR = wp.constant(wp.vec3(0.30, 0.46, 0.68))
GROUND_GLOW = wp.constant(wp.vec3(0.25, 0.235, 0.22))
SKY_GLOW = wp.constant(wp.vec3(0.38, 0.43, 0.50))
LAMP_COLOR = wp.constant(wp.vec3(1.02, 0.94, 0.81))


@wp.struct
class CameraView:
    """A camera, as the rays see it, and a lamp.

    `right` and `up` extend from the centre of the image to its borders, at unit distance from the eye.
    """

    eye: wp.vec3
    forward: wp.vec3
    right: wp.vec3
    up: wp.vec3
    light: wp.vec3
    lamp_radius: float  # of the lamp at unit distance; 0 casts sharp shadows
    shade_reach: float  # distance over which surfaces occlude the sky [m]; 0 for no ambient occlusion
    grid: float  # distance between grid lines on flat grounds [m]
    haze: float  # distance at which grounds start to fade [m]
    pixel: float  # width of a pixel at unit distance from the eye


@wp.func
def line_coverage(coordinate: float, spacing: float, footprint: float) -> float:
    """Fraction of a pixel covered by a grid line; `footprint` is the pixel width on the ground."""
    offset = wp.abs(coordinate / spacing - wp.round(coordinate / spacing)) * spacing
    width = 0.006 * spacing + footprint
    return wp.clamp((width - offset) / footprint, 0.0, 1.0) * wp.min(width / spacing * 8.0, 1.0)


@wp.func
def grid_shade(point: wp.vec3, normal: wp.vec3, spacing: float, footprint: float) -> float:
    """Brightness of a flat ground with grid lines along the two axes closest to its plane."""
    a = point[0]
    b = point[1]
    if wp.abs(normal[0]) > wp.abs(normal[2]):
        a = point[2]
    elif wp.abs(normal[1]) > wp.abs(normal[2]):
        b = point[2]
    fade = wp.clamp(1.0 - 4.0 * footprint / spacing, 0.0, 1.0)
    lines = wp.max(line_coverage(a, spacing, footprint), line_coverage(b, spacing, footprint))
    return 1.0 - 0.25 * fade * lines


@wp.func
def sky_color(direction: wp.vec3) -> wp.vec3:
    """Background colour."""
    return wp.lerp(HORIZON_COLOR, ZENITH_COLOR, wp.sqrt(wp.clamp(direction[2], 0.0, 1.0)))


@wp.func
def lit_color(camera: CameraView, color: wp.vec3, normal: wp.vec3, sun: float, sky: float) -> wp.vec3:
    """Light that a surface sends back, from the lamp and the sky."""
    ambient = wp.lerp(GROUND_GLOW, SKY_GLOW, 0.5 + 0.5 * normal[2]) * (0.22 + 0.78 * sky)
    direct = wp.max(wp.dot(normal, camera.light), 0.0) * sun * LAMP_COLOR
    return wp.cw_mul(color, ambient + direct)


@wp.func
def glossy_color(
    camera: CameraView, color: wp.vec3, normal: wp.vec3, point: wp.vec3, gloss: wp.vec2, sun: float, sky: float
) -> wp.vec3:
    """Light of a surface that also mirrors the lamp and the sky: UsdPreviewSurface with the GGX distribution."""
    roughness, metallic = wp.max(gloss[0], 0.1), gloss[1]
    toward = wp.normalize(camera.eye - point)
    half = wp.normalize(camera.light + toward)
    nl = wp.max(wp.dot(normal, camera.light), 1.0e-3)
    nv = wp.max(wp.dot(normal, toward), 1.0e-3)
    nh = wp.max(wp.dot(normal, half), 0.0)
    mirrored = wp.lerp(wp.vec3(0.04, 0.04, 0.04), color, metallic)
    rest = wp.vec3(1.0, 1.0, 1.0) - mirrored
    squared = wp.pow(roughness, 4.0)
    flat = nh * nh * (squared - 1.0) + 1.0
    k = (roughness + 1.0) * (roughness + 1.0) / 8.0
    shadow = 1.0 / ((nl * (1.0 - k) + k) * (nv * (1.0 - k) + k))
    # The lamp's colour is the light that a white matt surface sends back, a part of 1 / pi of what it receives.
    lobe = squared / (flat * flat) * shadow * 0.25 * nl * sun
    bright = wp.cw_mul(mirrored + rest * wp.pow(1.0 - wp.max(wp.dot(toward, half), 0.0), 5.0), LAMP_COLOR) * lobe
    back = 2.0 * wp.dot(normal, toward) * normal - toward
    around = wp.lerp(GROUND_GLOW, sky_color(back), wp.clamp(0.5 + back[2] / (0.1 + roughness), 0.0, 1.0))
    edge = mirrored + rest * wp.pow(1.0 - nv, 5.0) * (1.0 - roughness)
    reflection = wp.cw_mul(edge, around) * (0.22 + 0.78 * sky)
    return lit_color(camera, (1.0 - metallic) * color, normal, sun, sky) + bright + reflection
