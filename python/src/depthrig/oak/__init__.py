"""OAK cameras (Luxonis) as cameras of a rig: `python -m depthrig.oak --camera NAME --serial SERIAL`.

It drives the camera with the official `depthai` package and serves it over :class:`depthrig.ExternalCamera`. depthrig
does not depend on that package: `pip install './python[oak]'` in a checkout. `--replay FOLDER` serves recorded files
through the same pipeline in place of a camera.
"""
