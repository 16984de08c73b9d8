//! The numbers that stand for something in the messages of the hand-shake. Each is part of the wire format and never
//! changes; those that a later version adds read as `None`.

macro_rules! codes {
    ($(#[$doc:meta])* $name:ident { $($(#[$line:meta])* $variant:ident = $code:literal $text:literal,)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[repr(u32)]
        #[non_exhaustive]
        pub enum $name { $($(#[$line])* $variant = $code,)* }

        impl $name {
            /// All of them, in wire order.
            pub const ALL: &[Self] = &[$(Self::$variant),*];

            /// That of a wire code, if this version knows it.
            pub fn from_code(code: u32) -> Option<Self> {
                Self::ALL.iter().copied().find(|c| *c as u32 == code)
            }

            /// The name used in documentation and in other languages.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $text),* }
            }
        }
    };
}

codes! {
    /// How a process that serves a camera stands.
    ExternalState {
        /// It serves, and nobody wants frames, or it has not taken up the session yet.
        Idle = 0 "idle",
        /// It has taken up the session and starts the camera.
        Starting = 1 "starting",
        /// Frames of the session come.
        Running = 2 "running",
        /// It cannot run the session; `reason` and `text` say why.
        Refused = 3 "refused",
        /// It goes; `reason` and `text` say why. The last message of a process.
        Ended = 4 "ended",
    }
}

codes! {
    /// What the daemon wants of a process that serves a camera.
    ExternalWant {
        /// No frames.
        Stop = 0 "stop",
        /// Frames of the modes in the payload.
        Run = 1 "run",
        /// Nothing: the offer or its frames cannot be used; `reason` and `text` say why.
        Refused = 2 "refused",
    }
}

codes! {
    /// Why one side refuses, or a process ends.
    ExternalReason {
        /// None was given.
        None = 0 "none",
        /// The other side speaks another version of the hand-shake.
        Version = 1 "version",
        /// A message cannot be what it says.
        Invalid = 2 "invalid",
        /// The camera cannot do what was asked.
        Unsupported = 3 "unsupported",
        /// The camera is not there.
        NotFound = 4 "not_found",
        /// Somebody else holds the camera.
        Busy = 5 "busy",
        /// The process may not open the camera.
        Permission = 6 "permission",
        /// The camera was pulled out.
        Disconnected = 7 "disconnected",
        /// The camera or its SDK failed.
        Device = 8 "device",
        /// There are no more frames, and there will be none: files at their end.
        Finished = 9 "finished",
    }
}

codes! {
    /// Which clock stamps the frames of a mode.
    ExternalClock {
        /// None: the time of arrival is all there is.
        Arrival = 0 "arrival",
        /// The device's own, at mid-exposure.
        Device = 1 "device",
        /// The device's own, at some other moment, later than mid-exposure.
        DeviceHeader = 2 "device_header",
        /// `CLOCK_MONOTONIC` of this computer, in nanoseconds.
        Host = 3 "host",
    }
}

macro_rules! bits {
    ($(#[$doc:meta])* $name:ident { $($(#[$line:meta])* $flag:ident = $bit:expr, $text:literal;)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
        pub struct $name(pub u32);

        impl $name {
            $($(#[$line])* pub const $flag: Self = Self($bit);)*
            /// Every flag with its name.
            pub const ALL: &[(&'static str, Self)] = &[$(($text, Self::$flag)),*];

            /// Whether all bits of `flag` are set.
            pub const fn has(self, flag: Self) -> bool {
                self.0 & flag.0 == flag.0
            }

            /// Both sets of flags together.
            pub const fn with(self, other: Self) -> Self {
                Self(self.0 | other.0)
            }
        }
    };
}

bits! {
    /// Facts about a mode, one bit each. Bits that this version does not know are ignored.
    ExternalModeFlags {
        /// The frames are made by a program and not by a sensor.
        SIMULATED = 1, "simulated";
    }
}

bits! {
    /// Facts about a frame, one bit each. Bits that this version does not know are ignored.
    ExternalFrameFlags {
        /// The device or its SDK flagged the frame as damaged; it is counted and not published.
        DAMAGED = 1, "damaged";
        /// Captured on a hardware trigger.
        HARDWARE_TRIGGERED = 1 << 1, "hardware_triggered";
        /// The time of this frame did not come; `device_time` means nothing.
        METADATA_LOST = 1 << 2, "metadata_lost";
    }
}
