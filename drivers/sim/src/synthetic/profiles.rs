//! From a configuration to the stream modes that the camera offers.

use super::config::SyntheticConfig;
use super::models::{self, MODELS, Mode, Model};
use super::{imu, noise};
use depthrig_bus::{MetadataLevel, Name, PixelFormat, Pose};
use depthrig_driver::{DeviceClock, Error, ErrorKind, Result, StreamProfile, StreamRequest, choose_profiles};

/// Content of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Content {
    Color,
    Depth,
    DepthTrue,
    /// The true depth as the colour sensor would see it.
    DepthTrueColor,
}

impl Content {
    const ALL: [Self; 4] = [Self::Color, Self::Depth, Self::DepthTrue, Self::DepthTrueColor];

    /// Contents of a camera's streams, with or without its truth.
    fn of_camera(truth: bool) -> &'static [Self] {
        if truth { &Self::ALL } else { &Self::ALL[..2] }
    }

    /// Whether the colour sensor's optics, place and timing are its own.
    pub(crate) const fn is_color_view(self) -> bool {
        matches!(self, Self::Color | Self::DepthTrueColor)
    }

    /// The stream whose mode a truth follows.
    const fn follows(self) -> Option<Self> {
        match self {
            Self::Color | Self::Depth => None,
            Self::DepthTrue => Some(Self::Depth),
            Self::DepthTrueColor => Some(Self::Color),
        }
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Color => "color",
            Self::Depth => "depth",
            Self::DepthTrue => "depth_true",
            Self::DepthTrueColor => "depth_true_color",
        }
    }

    /// Content of the stream called `name`.
    pub(crate) fn of(name: &Name) -> Option<Self> {
        Self::ALL.into_iter().find(|c| c.name() == name.as_str())
    }
}

/// The configured model.
pub(crate) fn model_of(config: &SyntheticConfig) -> Result<&'static Model> {
    models::find(&config.model).ok_or_else(|| {
        let names: Vec<_> = MODELS.iter().map(|m| m.name).collect();
        let label = config.label();
        let text = format!("{label}: there is no model \"{}\"; there are {}", config.model, names.join(", "));
        Error::new(ErrorKind::BadInput, text)
    })
}

/// Every mode of the configured camera; the first of each stream is its default.
///
/// # Errors
/// [`ErrorKind::BadInput`] for an unknown model or an impossible number, [`ErrorKind::Unsupported`] for an
/// override that is not a mode of the model, naming its modes.
pub fn profiles(config: &SyntheticConfig) -> Result<Vec<StreamProfile>> {
    config.validate()?;
    let model = model_of(config)?;
    let mut all = Vec::new();
    let contents = Content::of_camera(config.truth);
    for content in contents.iter().copied() {
        let modes = if content.is_color_view() { model.color_modes } else { model.depth_modes };
        let mut own = Vec::new();
        for mode in modes {
            for rate_hz in mode.rates_hz {
                own.push(profile(config, model, content, mode, *rate_hz)?);
            }
        }
        put_override_first(config, model, content, modes, &mut own)?;
        all.append(&mut own);
    }
    if config.motion {
        all.push(imu::profile(Name::new(imu::STREAM).map_err(bad_name)?, config.clock.counter_bits));
    }
    for o in &config.streams {
        if all.iter().all(|p| p.stream != o.stream) {
            let names: Vec<_> = contents.iter().map(|c| c.name()).collect();
            let hint = match Content::of(&o.stream) {
                Some(_) => " (set truth = true)",
                None if o.stream.as_str() == imu::STREAM => " (set motion = true)",
                None => "",
            };
            let message = format!(
                "{}: it has no stream \"{}\"{hint}; it has {}",
                config.label(),
                o.stream,
                names.join(", ")
            );
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
    }
    Ok(all)
}

/// The modes that a start without requests would choose.
pub(crate) fn default_profiles(config: &SyntheticConfig) -> Result<Vec<StreamProfile>> {
    choose_profiles(&config.label(), &profiles(config)?, &[])
}

/// Makes the overridden mode of a stream its first.
fn put_override_first(
    config: &SyntheticConfig,
    model: &Model,
    content: Content,
    modes: &[Mode],
    own: &mut Vec<StreamProfile>,
) -> Result<()> {
    // A truth follows what was said of the stream whose view it has, unless something was said of itself.
    let said = |content: Content| config.streams.iter().rev().find(|o| o.stream.as_str() == content.name());
    let Some(wish) = said(content).or_else(|| content.follows().and_then(said)) else {
        return Ok(());
    };
    let chosen = if config.cheap || model.name == "generic" {
        let base = modes[0];
        let (width, height) = wish.size.unwrap_or((base.width, base.height));
        let rate_hz = wish.rate_hz.unwrap_or(base.rates_hz[0]);
        let is_possible =
            [width, height].iter().all(|n| (1..=16_384).contains(n)) && rate_hz > 0.0 && rate_hz <= 2000.0;
        if !is_possible {
            let message = format!(
                "{}: {} of {width}x{height} at {rate_hz} Hz is impossible; sizes go from 1 to 16384, rates to 2000 Hz",
                config.label(),
                content.name()
            );
            return Err(Error::new(ErrorKind::BadInput, message));
        }
        let focal_px = base.focal_px * f64::from(width) / f64::from(base.width);
        profile(config, model, content, &Mode { width, height, focal_px, ..base }, rate_hz)?
    } else {
        let stream = Name::new(content.name()).map_err(bad_name)?;
        let request = StreamRequest { size: wish.size, rate_hz: wish.rate_hz, ..StreamRequest::any(stream) };
        choose_profiles(&config.label(), own, &[request])?.swap_remove(0)
    };
    own.retain(|p| *p != chosen);
    own.insert(0, chosen);
    Ok(())
}

fn profile(
    config: &SyntheticConfig,
    model: &Model,
    content: Content,
    mode: &Mode,
    rate_hz: f64,
) -> Result<StreamProfile> {
    // Up to 1 % of the image; a truth has the lens of the sensor whose view it has.
    let sensor = u32::from(!content.is_color_view());
    let rolls = noise::Rolls::new(noise::text_seed(config.seed, &config.serial_or_default()), sensor, 0, 0);
    let off = [0, 1].map(|i| (f64::from(rolls.unit(i)) - 0.5) * 0.02);
    let color = content == Content::Color;
    Ok(StreamProfile {
        stream: Name::new(content.name()).map_err(bad_name)?,
        format: if color { PixelFormat::Rgb8 } else { PixelFormat::Z16 },
        width: mode.width,
        height: mode.height,
        rate_hz,
        depth_unit_m: if color { 0.0 } else { model.depth_unit_m },
        intrinsics: mode.intrinsics(off),
        pose_in_device: if content.is_color_view() { model.color_in_device } else { Pose::IDENTITY },
        clock: DeviceClock::microseconds(config.clock.counter_bits),
        sequence_bits: 32,
        metadata: MetadataLevel::Simulated,
    })
}

fn bad_name(e: depthrig_bus::Error) -> Error {
    Error::new(ErrorKind::BadInput, "a stream name of the synthetic cameras breaks the rule of names")
        .with_source(e)
}

#[cfg(test)]
mod tests {
    use super::super::config::StreamOverride;
    use super::*;

    fn config(model: &str) -> SyntheticConfig {
        SyntheticConfig { model: model.into(), truth: true, ..SyntheticConfig::default() }
    }

    #[test]
    fn default_modes_are_those_of_the_mount() {
        for (model, wanted) in [
            ("d405", "color 1280x720 rgb8 30 Hz, depth 1280x720 z16 30 Hz"),
            ("d455", "color 1280x800 rgb8 30 Hz, depth 1280x720 z16 30 Hz"),
            ("l515", "color 1280x720 rgb8 30 Hz, depth 1024x768 z16 30 Hz"),
            ("Kinect", "color 1280x720 rgb8 15 Hz, depth 1024x1024 z16 15 Hz"),
        ] {
            let list = default_profiles(&SyntheticConfig { truth: false, ..config(model) }).unwrap();
            assert_eq!(list.iter().map(StreamProfile::describe).collect::<Vec<_>>().join(", "), wanted);
        }
        let units: Vec<_> = ["d405", "d435", "l515", "kinect"]
            .map(|m| default_profiles(&config(m)).unwrap()[1].depth_unit_m)
            .to_vec();
        assert_eq!(units, [0.0001, 0.001, 0.00025, 0.001]);
    }

    #[test]
    fn an_override_becomes_the_default_and_truth_follows_depth() {
        let mut c = config("d435");
        let stream = Name::new("depth").unwrap();
        c.streams.push(StreamOverride { stream, size: Some((848, 480)), rate_hz: Some(60.0) });
        let list = default_profiles(&c).unwrap();
        assert_eq!(list[1].describe(), "depth 848x480 z16 60 Hz");
        assert_eq!(list[2].describe(), "depth_true 848x480 z16 60 Hz");
        assert_eq!(list[1].intrinsics, list[2].intrinsics);
        assert_eq!(list[3].describe(), "depth_true_color 1280x720 z16 30 Hz");
        let stream = Name::new("color").unwrap();
        c.streams.push(StreamOverride { stream, size: Some((640, 480)), rate_hz: None });
        let with_color = default_profiles(&c).unwrap();
        let [color, depth, _, in_color] = &with_color[..] else { panic!("{with_color:?}") };
        assert_eq!(in_color.describe(), "depth_true_color 640x480 z16 30 Hz");
        assert_eq!((in_color.intrinsics, in_color.pose_in_device), (color.intrinsics, color.pose_in_device));
        assert!(
            in_color.depth_unit_m == depth.depth_unit_m && in_color.pose_in_device != depth.pose_in_device
        );
        c.streams[0].size = Some((850, 480));
        let e = profiles(&c).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::Unsupported);
        assert!(
            e.to_string().contains("; it has: depth 1280x720 z16 30, 15, 6 Hz; depth 848x480 z16 "),
            "{e}"
        );
        c.cheap = true;
        assert_eq!(default_profiles(&c).unwrap()[1].describe(), "depth 850x480 z16 60 Hz");
    }

    #[test]
    fn an_imu_is_there_when_it_is_asked_for() {
        let mut c = config("d435");
        assert!(profiles(&c).unwrap().iter().all(|p| !p.format.is_motion()));
        c.streams.push(StreamOverride { stream: Name::new("imu").unwrap(), size: None, rate_hz: None });
        assert!(profiles(&c).unwrap_err().to_string().contains("motion = true"));
        c.motion = true;
        let last = default_profiles(&c).unwrap().pop().unwrap();
        assert_eq!(last.describe(), "imu motion 200 Hz in batches of up to 8");
        assert_eq!((last.frame_bytes(), last.height), (512, 1));
    }

    #[test]
    fn unknown_models_and_streams_name_what_there_is() {
        let e = profiles(&config("d436")).unwrap_err();
        assert!(e.to_string().contains("d405, d415, d435"), "{e}");
        for name in ["depth_true", "depth_true_color"] {
            let mut c = SyntheticConfig { truth: false, ..config("d435") };
            let stream = Name::new(name).unwrap();
            c.streams.push(StreamOverride { stream, size: None, rate_hz: None });
            assert!(profiles(&c).unwrap_err().to_string().contains("truth = true"));
        }
    }
}
