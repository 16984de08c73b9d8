"""Writes mrcal_uncertainty.json: mrcal's uncertainty of projection for the corners in opencv_corners.json.

    /usr/bin/python3 mrcal_uncertainty.py > mrcal_uncertainty.json

Needs Debian's python3-mrcal (2.2).
"""

import json
from pathlib import Path

import mrcal
import numpy as np

LENS = "LENSMODEL_OPENCV5"
SIZE = (640, 480)


def solved(camera):
    corners = np.array(camera["corners"])
    count = len(corners)
    observations = np.ones((count, 6, 9, 3))
    observations[..., :2] = corners.reshape(count, 6, 9, 2)
    indices = np.zeros((count, 3), dtype=np.int32)
    indices[:, 0] = np.arange(count)
    indices[:, 2] = -1
    intrinsics = np.array(camera["intrinsics"])[None, :].copy()
    start = mrcal.cameramodel(intrinsics=(LENS, intrinsics[0]), imagersize=SIZE)
    poses = mrcal.estimate_monocular_calobject_poses_Rt_tocam(indices[:, :2].copy(), observations, 1.0, [start])
    inputs = {
        "intrinsics": intrinsics,
        "extrinsics_rt_fromref": np.zeros((0, 6)),
        "frames_rt_toref": np.array([mrcal.rt_from_Rt(pose) for pose in poses]),
        "points": None,
        "observations_board": observations,
        "indices_frame_camintrinsics_camextrinsics": indices,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": LENS,
        "imagersizes": np.array([SIZE], dtype=np.int32),
        "calobject_warp": None,
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": True,
        "do_optimize_frames": True,
        "do_optimize_calobject_warp": False,
        "calibration_object_spacing": 1.0,
        "point_min_range": 0.1,
        "point_max_range": 1000.0,
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": False,
        "verbose": False,
    }
    residuals = mrcal.optimize(**inputs)["x"]
    return mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=0), float(np.std(residuals))


def main():
    reference = json.loads(Path(__file__).with_name("opencv_corners.json").read_text())
    out = {}
    for name, camera in reference["cameras"].items():
        model, sigma = solved(camera)
        samples = []
        for pixel in ((320, 240), (20, 20), (620, 20), (20, 460), (620, 460), (500, 240)):
            ray = mrcal.unproject(np.array(pixel, float), *model.intrinsics(), normalize=True)
            for distance in (None, 5.0, 20.0):
                sigma_px = mrcal.projection_uncertainty(
                    ray * (distance or 1.0), model, atinfinity=distance is None, what="worstdirection-stdev"
                )
                samples.append({"pixel": pixel, "distance": distance, "sigma_px": float(sigma_px)})
        out[name] = {"intrinsics": model.intrinsics()[1].tolist(), "sigma_px": sigma, "samples": samples}
    print(json.dumps(out))


main()
