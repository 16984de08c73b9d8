//! The backend: finds the process of its camera, or starts it.

use super::device::ExternalDevice;
use super::process::{Keeper, SharedKeeper, kill, stalled};
use super::stream::is_of;
use super::{ExternalConfig, NAME, Place, of_bus};
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_bus::external::{
    Answer, Beat, ExternalLink, ExternalReason, ExternalState, ExternalWant, Offer,
};
use depthrig_bus::sync::lock;
use depthrig_driver::{Backend, Device, DeviceInfo, Error, ErrorKind, Result, StreamProfile};
use std::sync::{Arc, Mutex, MutexGuard};

/// How often a process that has just been started is looked for.
const LOOK: Duration = Duration::from_millis(20);

/// The backend of one camera that another process serves.
#[derive(Debug)]
pub struct ExternalBackend {
    config: ExternalConfig,
    place: Place,
    keeper: SharedKeeper,
}

impl ExternalBackend {
    /// The camera at `place`, served as `config` says. Nothing is started before [`Backend::open`].
    pub fn new(config: ExternalConfig, place: Place) -> Self {
        let keeper =
            (!config.command.is_empty()).then(|| Arc::new(Mutex::new(Keeper::new(config.program(&place)))));
        Self { config, place, keeper }
    }

    fn keeper(&self) -> Option<MutexGuard<'_, Keeper>> {
        Some(lock(self.keeper.as_ref()?))
    }

    /// Waits until a process serves the camera; only one that the daemon starts is waited for.
    fn find_process(&self) -> Result<()> {
        let holder = self.place.holder();
        let Some(mut keeper) = self.keeper() else {
            return holder.map(drop).ok_or_else(|| {
                Error::new(
                    ErrorKind::NotFound,
                    "no process serves it; start the one that does, or name it in the rig file as `command`",
                )
            });
        };
        if let (Some(holder), None) = (holder, keeper.pid()) {
            let why = format!(
                "{holder} serves it already, so `command` cannot; end that process, or leave `command` out"
            );
            return Err(Error::new(ErrorKind::Busy, why));
        }
        keeper.ensure()?;
        drop(keeper);
        let deadline = HostTime::now().plus(self.config.start_timeout);
        while self.place.holder().is_none() {
            if let Some(mut keeper) = self.keeper() {
                keeper.ensure()?;
            }
            if deadline.from_now().is_zero() {
                let s = self.config.start_timeout.as_secs_f64();
                let what = format!("offered no camera within {s:.1} s");
                let pid = self.keeper().and_then(|k| k.pid()).unwrap_or(0);
                kill(&self.keeper, &what);
                return Err(stalled(ErrorKind::NotFound, &self.keeper, pid, &what));
            }
            std::thread::sleep(LOOK);
        }
        Ok(())
    }

    /// Waits for a message of the process that holds the camera's lock.
    fn hear(&self, link: &ExternalLink) -> Result<(Beat, depthrig_bus::Result<Offer>)> {
        let deadline = HostTime::now().plus(self.config.heartbeat_timeout);
        loop {
            let Some(holder) = self.place.holder() else {
                return Err(Error::new(ErrorKind::NotFound, "its process ended while it was being opened"));
            };
            let fresh = |beat: &Beat| {
                beat.sent.elapsed() < self.config.heartbeat_timeout
                    && beat.state != Some(ExternalState::Ended)
                    && is_of(&holder, beat.pid)
            };
            if let Some(said) = link.newest(fresh).map_err(of_bus)? {
                return Ok((said.beat, said.offer()));
            }
            let left = deadline.from_now();
            if left.is_zero() {
                let s = self.config.heartbeat_timeout.as_secs_f64();
                let pid = self.keeper().and_then(|k| k.pid());
                let what = format!("has said nothing for {s:.1} s");
                kill(&self.keeper, &what);
                return Err(match pid {
                    Some(pid) => stalled(ErrorKind::Disconnected, &self.keeper, pid, &what),
                    None => Error::new(
                        ErrorKind::Disconnected,
                        format!("{holder} serves it and {what}; if it hangs, end it and start it again"),
                    ),
                });
            }
            link.sleep(left).map_err(of_bus)?;
        }
    }

    /// Reads what the process offers now. Nothing is sent to it, so whoever uses the camera is not disturbed.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when no process serves it, [`ErrorKind::Disconnected`] when that says nothing,
    /// [`ErrorKind::Protocol`] when its offer is invalid, else the reason for which it reports no camera.
    pub fn offered(&self) -> Result<(DeviceInfo, Vec<StreamProfile>)> {
        if self.place.holder().is_none() {
            return Err(Error::new(ErrorKind::NotFound, "no process serves it"));
        }
        let device = self.device(false)?;
        Ok((device.info().clone(), device.profiles().to_vec()))
    }

    /// Reads the offer. An invalid one is refused; with `answers` the reason goes to the process too.
    fn meet(&self, answers: bool) -> Result<(ExternalLink, Beat, Offer)> {
        let mut link = ExternalLink::open(&self.place).map_err(of_bus)?;
        let (beat, offer) = self.hear(&link)?;
        let why = match offer {
            Ok(offer) => return Ok((link, beat, offer)),
            Err(e) => e,
        };
        let text = why.to_string();
        let reason = match why.kind() {
            depthrig_bus::ErrorKind::VersionMismatch => ExternalReason::Version,
            _ => ExternalReason::Invalid,
        };
        let refusal = Answer {
            instance: beat.instance,
            session: 0,
            want: ExternalWant::Refused,
            reason,
            text: &text,
            modes: &[0],
        };
        if answers && let Err(e) = link.answer(&refusal) {
            tracing::debug!(error = %e, "the refusal could not be sent to the process");
        }
        let what = format!("the offer of its process {} is invalid: {text}", beat.pid);
        Err(Error::new(ErrorKind::Protocol, what).with_source(why))
    }

    fn device(&self, answers: bool) -> Result<ExternalDevice> {
        let (link, beat, offer) = self.meet(answers)?;
        ExternalDevice::new(&self.config, &self.place, self.keeper.clone(), link, beat, offer)
    }
}

impl Backend for ExternalBackend {
    fn name(&self) -> &'static str {
        NAME
    }

    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        match self.offered() {
            Ok((info, _)) => Ok(vec![info]),
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(Vec::new()),
            Err(e) => Err(e),
        }
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        self.find_process()?;
        let device = self.device(true)?;
        if let Some(serial) = serial
            && serial != device.info().serial
        {
            let there = &device.info().serial;
            return Err(Error::new(
                ErrorKind::NotFound,
                format!("no camera with serial number \"{serial}\"; its process serves \"{there}\""),
            ));
        }
        Ok(Box::new(device))
    }
}
