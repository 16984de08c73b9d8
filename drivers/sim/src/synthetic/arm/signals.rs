//! The robot's process beside simulated cameras: it publishes the arm that they see.

use super::{Arm, JOINTS};
use core::time::Duration;
use depthrig_bus::{
    FieldType, HostTime, Result, RuntimeDir, SignalDescription, SignalField, SignalName, SignalPublisher,
    Signals, Stamp,
};

/// From one sample to the next.
const PERIOD: Duration = Duration::from_millis(10);
/// Actions are where the arm will be after this.
const AHEAD: Duration = Duration::from_millis(200);

/// The signals of the arm: `arm/joint_position`, `arm/gripper` and `arm/action`, its targets.
pub struct ArmSignals {
    joints: SignalPublisher,
    gripper: SignalPublisher,
    action: SignalPublisher,
    /// It keeps the channels open.
    _place: Signals,
}

impl ArmSignals {
    /// Number of the signals.
    pub const COUNT: usize = 3;

    /// Opens the channels.
    ///
    /// # Errors
    /// As [`Signals::open`].
    pub fn new(runtime: &RuntimeDir) -> Result<Self> {
        let place = Signals::open(runtime)?;
        let name = SignalName::new("arm", "joint_position")?;
        let joints = place.publisher(&SignalDescription::joints(name, &JOINTS, "rad")?)?;
        let opening = vec![SignalField::new("opening", FieldType::F64, "m")];
        let targets = JOINTS.iter().map(|j| SignalField::new(*j, FieldType::F64, "rad"));
        let targets = targets.chain(opening.iter().cloned()).collect();
        let name = SignalName::new("arm", "gripper")?;
        let gripper = place.publisher(&SignalDescription::fields(name, opening)?)?;
        let name = SignalName::new("arm", "action")?;
        let action = place.publisher(&SignalDescription::fields(name, targets)?)?;
        Ok(Self { joints, gripper, action, _place: place })
    }

    /// Publishes the arm a hundred times a second until it is over.
    ///
    /// # Errors
    /// Of a channel.
    pub fn run(&mut self, is_over: impl Fn() -> bool) -> Result<()> {
        while !is_over() {
            let now = HostTime::now();
            let arm = Arm::at(now);
            self.joints.publish_at(&Stamp::at(now), arm.joints_rad)?;
            self.gripper.publish_at(&Stamp::at(now), [arm.opening_m])?;
            let next = Arm::at(now.plus(AHEAD));
            let target = next.joints_rad.into_iter().chain([next.opening_m]);
            self.action.publish_at(&Stamp::at(now), target)?;
            std::thread::sleep(PERIOD);
        }
        Ok(())
    }
}
