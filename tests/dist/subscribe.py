"""A subscriber: the newest depth of a running rig, in metres."""

import depthrig

with depthrig.Stream("cam/depth", rig="clean", timeout=30) as stream:
    for _ in range(5):
        frame = stream.wait_fresh(max_age=5.0)
    depth = frame.depth_m()
    assert depth.shape == (240, 320), depth.shape
    values = depth[depth > 0]
    assert values.size > 0, "no depth in the image"
    print(f"Python: depth {depth.shape}, {values.min():.3f} to {values.max():.3f} m, age {frame.age_s:.3f} s")
