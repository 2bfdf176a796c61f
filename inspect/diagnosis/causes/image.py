"""Causes in the camera and its images."""

from __future__ import annotations

from beliefscope.inspect.diagnosis.cause import Cause, Command, Symptom
from beliefscope.inspect.diagnosis.causes.consequences import IMAGE

HAND = "hand offset/image*"
"""Position of the hand in the image against the measured one."""

OBJECT = "object offset/*"
"""Position of the object in the image against the labelled one."""

EXPOSURE = "brightness/image/*|clipped/image/*"
"""Brightness of the image, and saturated pixels."""

LANDMARKS = f"{HAND}|{OBJECT}|hand match/image*|object match/*"
"""Everything about landmarks in the image."""

CHECK = "Check the camera and its driver; until then, run the filter without the image."

CAUSES = (
    Cause(
        "image.blackout",
        "Images blacked out",
        (Symptom("black/image/*|losses/image/*"),),
        f"lag/image/*|frozen/image/*|{IMAGE}",
        CHECK,
        "skip lost images",
    ),
    Cause(
        "image.frozen",
        "Image frozen",
        (Symptom("frozen/image/*"),),
        f"lag/image/*|black/image/*|losses/image/*|noise/image/*|occlusion/image/*|shift/image*|sharpness/image/*"
        f"|{EXPOSURE}|{LANDMARKS}|{IMAGE}",
        CHECK,
        "drop image",
    ),
    Cause(
        "image.delay",
        "Image delayed",
        (Symptom("lag/image/*"),),
        f"frozen/image/*|shift/image*|{LANDMARKS}|{IMAGE}",
        "Synchronise the clocks of camera and robot, or delay the other sensors by the same number of steps.",
        "advance image",
    ),
    Cause(
        "image.shift",
        "Camera moved",
        (
            Symptom(f"shift/image*|{HAND}", 0),
            Symptom("shift/image*|module bias/*image*", 0, 0.5),
            Symptom(OBJECT, 0, 0.3, optional=True),
        ),
        f"{LANDMARKS}|occlusion/image/*|{EXPOSURE}|sharpness/image/*|{IMAGE}",
        "Calibrate the camera pose again.",
        "realign image",
    ),
    Cause(
        "image.noise",
        "Image noisy",
        (Symptom("noise/image/*"),),
        f"sharpness/image/*|shift/image*|occlusion/image/*|{EXPOSURE}|lag/image/*|{LANDMARKS}|{IMAGE}",
        "Reduce the camera's gain, or train with noisy images",
        "drop image",
        command=Command("finetune", "--faults image_noise=40"),
        by_hand="Reduce the camera's gain.",
    ),
    Cause(
        "image.blur",
        "Image blurred",
        (Symptom("sharpness/image/*", -1),),
        f"shift/image*|lag/image/*|{LANDMARKS}|{IMAGE}",
        "Focus the camera and clean its lens, or shorten the exposure time.",
        "drop image",
        lowers="noise/image/*",
    ),
    Cause(
        "image.exposure",
        "Image exposure changed",
        (Symptom("brightness/image/*", 0, otherwise=(Symptom("clipped/image/*"),)),),
        f"sharpness/image/*|occlusion/image/*|shift/image*|lag/image/*|{LANDMARKS}|{IMAGE}",
        "Restore the camera's exposure or the lighting.",
        "expose image",
        lowers="noise/image/*",
    ),
    Cause(
        "image.occlusion",
        "Image occluded",
        (Symptom("occlusion/image/*"),),
        f"shift/image*|{EXPOSURE}|lag/image/*|{LANDMARKS}|{IMAGE}",
        "Clear the camera's view.",
        "drop image",
        lowers="noise/image/*|sharpness/image/*",
    ),
)
