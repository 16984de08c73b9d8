//! Writes a rig's image settings to the camera and reads them back.

use super::ZedConfig;
use super::command::Vendor;
use super::mode::Side;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::uvc::control::ControlPort;
use depthrig_v4l2::Node;

/// Checks what can be checked without a camera.
///
/// # Errors
/// [`ErrorKind::BadInput`] naming the setting.
pub fn check(config: &ZedConfig) -> Result<()> {
    let bad = |what: &str| Err(Error::new(ErrorKind::BadInput, what.to_owned()));
    let too_high = |v: Option<u8>| v.is_some_and(|v| v > 100);
    if too_high(config.exposure_percent) {
        return bad("exposure_percent must be within 0 and 100");
    }
    if too_high(config.gain_percent) {
        return bad("gain_percent must be within 0 and 100");
    }
    let fixed = config.exposure_percent.is_some() || config.gain_percent.is_some();
    if fixed && config.auto_exposure == Some(true) {
        return bad(
            "auto_exposure = true regulates exposure and gain; keep it or exposure_percent and gain_percent",
        );
    }
    Ok(())
}

/// Whether `config` asks for anything that goes by vendor commands.
pub const fn has_commands(config: &ZedConfig) -> bool {
    config.auto_exposure.is_some()
        || config.exposure_percent.is_some()
        || config.gain_percent.is_some()
        || config.led.is_some()
}

/// Writes exposure, gain and light at the streamed rate and reads them back. Each command may take as long as the
/// kernel's control time-out, so this is never done on a thread that captures.
///
/// # Errors
/// Those of [`Vendor::send`]; [`ErrorKind::Protocol`] when the camera does not take a value.
pub fn apply<P: ControlPort>(vendor: &mut Vendor<P>, config: &ZedConfig, rate_hz: f64) -> Result<()> {
    let fixed = config.exposure_percent.is_some() || config.gain_percent.is_some();
    if let Some(on) = config.auto_exposure.or(fixed.then_some(false)) {
        vendor.set_auto_exposure(on)?;
    }
    for side in Side::BOTH {
        if let Some(percent) = config.exposure_percent {
            vendor.set_exposure(side, percent, rate_hz)?;
        }
        if let Some(percent) = config.gain_percent {
            vendor.set_gain(side, percent)?;
        }
    }
    config.led.map_or(Ok(()), |on| vendor.set_led(on))
}

/// Writes the kernel's controls.
///
/// # Errors
/// Those of [`Node::set_control`].
pub fn apply_controls(node: &Node, config: &ZedConfig) -> Result<()> {
    if config.controls.is_empty() {
        return Ok(());
    }
    let there_are = node.controls()?;
    config.controls.iter().try_for_each(|(name, value)| node.set_control(&there_are, name, value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_contradict_each_other_are_refused() {
        let config = ZedConfig::default;
        assert!(check(&config()).is_ok() && !has_commands(&config()));
        let ok = ZedConfig {
            exposure_percent: Some(100),
            gain_percent: Some(0),
            auto_exposure: Some(false),
            ..config()
        };
        assert!(check(&ok).is_ok() && has_commands(&ok));
        for (bad, wanted) in [
            (ZedConfig { exposure_percent: Some(101), ..config() }, "exposure_percent must be"),
            (ZedConfig { gain_percent: Some(255), ..config() }, "gain_percent must be"),
            (ZedConfig { gain_percent: Some(1), auto_exposure: Some(true), ..config() }, "keep it or"),
        ] {
            let e = check(&bad).unwrap_err();
            assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains(wanted), "{e}");
        }
    }
}
