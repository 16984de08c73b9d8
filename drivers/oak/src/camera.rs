//! The camera: its pipeline as the Python bridge builds it, as far as the `depthai` crate goes.

use crate::Error;
use crate::arguments::Wishes;
use depthai::camera::{CameraNode, CameraOutputConfig, ImageFrame, OutputQueue};
use depthai::common::{CameraBoardSocket, ImageFrameType};
use depthai::device::{Device, DevicePlatform};
use depthai::image_align::ImageAlignNode;
use depthai::pipeline::Pipeline;
use depthai::stereo_depth::{PresetMode, StereoDepthNode};
use depthrig_bus::PixelFormat;

/// Frames that may wait in a queue of the SDK, which drops the oldest without a report.
const QUEUE: u32 = 4;
/// A size that the mono sensors of every OAK-D support.
const STEREO_SIZE: (u32, u32) = (640, 400);

/// A running camera.
pub struct Camera {
    /// Ends with its last handle.
    device: Device,
    pipeline: Pipeline,
    streams: Vec<Stream>,
}

/// A stream of it.
pub struct Stream {
    /// `color` or `depth`.
    pub name: &'static str,
    /// Format of its frames.
    pub format: PixelFormat,
    /// As the SDK calls that.
    kind: ImageFrameType,
    queue: OutputQueue,
}

impl Camera {
    /// Opens the only camera that the SDK shows (see `serve::only`), builds its pipeline and starts it.
    ///
    /// # Errors
    /// Those of the SDK: no camera, one that is in use, a size that it cannot give.
    pub fn start(wishes: &Wishes) -> Result<Self, Error> {
        let device = Device::new()?;
        let sockets = device.connected_cameras()?;
        let needed = [CameraBoardSocket::CamA, CameraBoardSocket::CamB, CameraBoardSocket::CamC];
        let needed = if wishes.depth { needed.as_slice() } else { &needed[..1] };
        if let Some(missing) = needed.iter().find(|s| !sockets.contains(s)) {
            return Err(format!("the camera has no sensor at {missing:?}; without depth: --no-depth").into());
        }
        if let Some(dots) = wishes.dots {
            device.set_ir_laser_dot_projector_intensity(dots)?;
        }
        let pipeline = Pipeline::new().with_device(&device).build()?;
        let color = pipeline.create_with::<CameraNode, _>(CameraBoardSocket::CamA)?;
        let color = color.request_output(CameraOutputConfig {
            frame_type: Some(ImageFrameType::BGR888i),
            fps: Some(wishes.rate_hz),
            // Aligned depth is undistorted.
            enable_undistortion: Some(true),
            ..CameraOutputConfig::new(wishes.size)
        })?;
        let mut streams = vec![Stream {
            name: "color",
            format: PixelFormat::Bgr8,
            kind: ImageFrameType::BGR888i,
            queue: color.create_queue(QUEUE, false)?,
        }];
        if wishes.depth {
            let mono = |socket| {
                let sensor = pipeline.create_with::<CameraNode, _>(socket)?;
                sensor.request_output(CameraOutputConfig {
                    fps: Some(wishes.rate_hz),
                    ..CameraOutputConfig::new(STEREO_SIZE)
                })
            };
            let stereo = pipeline.create::<StereoDepthNode>()?;
            stereo.set_default_profile_preset(PresetMode::Default);
            mono(CameraBoardSocket::CamB)?.link_to(stereo.as_node(), Some("left"))?;
            mono(CameraBoardSocket::CamC)?.link_to(stereo.as_node(), Some("right"))?;
            let depth = stereo.as_node().output("depth")?;
            // An RVC2 aligns inside the stereo node, an RVC4 in a node of its own (depthai-core `RGBD.cpp`, MIT).
            let depth = if device.platform()? == DevicePlatform::Rvc4 {
                let align = pipeline.create::<ImageAlignNode>()?;
                depth.link_to(align.as_node(), Some("input"))?;
                color.link_to(align.as_node(), Some("inputAlignTo"))?;
                align.as_node().output("outputAligned")?
            } else {
                color.link_to(stereo.as_node(), Some("inputAlignTo"))?;
                depth
            };
            streams.push(Stream {
                name: "depth",
                format: PixelFormat::Z16,
                kind: ImageFrameType::RAW16,
                queue: depth.create_queue(QUEUE, false)?,
            });
        }
        pipeline.start()?;
        Ok(Self { device, pipeline, streams })
    }

    /// Its streams.
    pub fn streams(&self) -> &[Stream] {
        &self.streams
    }

    /// Whether frames may still come.
    pub fn is_there(&self) -> bool {
        self.device.is_connected() && self.pipeline.is_running().unwrap_or(false)
    }
}

impl Stream {
    /// The next frame, if one is there.
    ///
    /// # Errors
    /// When the SDK has lost the camera.
    pub fn next(&self) -> Result<Option<ImageFrame>, Error> {
        Ok(self.queue.try_next()?)
    }

    /// Whether a frame is what the stream was announced as.
    pub fn fits(&self, frame: &ImageFrame, width: u32, height: u32) -> bool {
        frame.format() == Some(self.kind) && (frame.width(), frame.height()) == (width, height)
    }
}
