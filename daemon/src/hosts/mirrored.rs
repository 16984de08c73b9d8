//! Cameras of another computer whose streams are on the bus of this one, as they are seen here.

use crate::status::{
    CameraState, CameraStatus, HostState, HostStatus, MirrorState, MirrorStatus, StreamStatus,
};
use std::collections::BTreeSet;

/// The cameras of `host` that have a stream among `mirrors`; `there` is what its daemon said of all of its cameras at the last look, and `made` are the
/// streams that this computer makes of one. A camera that was never seen is there without streams.
pub(super) fn cameras(
    host: &HostStatus,
    there: &[CameraStatus],
    mirrors: &[MirrorStatus],
    made: &dyn Fn(&str) -> Vec<StreamStatus>,
) -> Vec<CameraStatus> {
    let names: BTreeSet<_> = mirrors.iter().filter_map(|m| Some(m.stream.split_once('/')?.0)).collect();
    let see = |name: &str| {
        let says = |mirror: &MirrorStatus| {
            Some(format!("{} does not come here: {}", mirror.stream, mirror.why.as_ref()?))
        };
        let known = there.iter().find(|camera| camera.name == name).cloned();
        let mut camera =
            known.unwrap_or_else(|| CameraStatus { name: name.to_owned(), ..CameraStatus::default() });
        let mut why = None;
        camera.streams.retain_mut(|stream| {
            let Some(mirror) = mirrors.iter().find(|m| m.stream == stream.id) else { return false };
            if mirror.state == MirrorState::Live {
                stream.rate_hz = mirror.rate_hz;
            }
            why = why.take().or_else(|| says(mirror));
            true
        });
        if camera.streams.is_empty() {
            let own = mirrors.iter().filter(|m| m.stream.split_once('/').is_some_and(|(c, _)| c == name));
            why = own.into_iter().find_map(says);
        }
        camera.streams.extend(made(name));
        let is_away = host.state != HostState::Connected;
        if is_away {
            let of_host = host.why.as_deref().unwrap_or("it does not answer");
            why = Some(format!("host {}: {of_host}", host.host));
        }
        // What is wrong there comes before what is wrong on the way.
        let is_well_there = matches!(camera.state, CameraState::Streaming | CameraState::Opening);
        if let Some(why) = why.filter(|_| is_away || is_well_there) {
            camera.message = Some(why);
            if camera.state == CameraState::Streaming {
                camera.state = CameraState::Stalled;
            }
        }
        camera
    };
    names.into_iter().map(see).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn host(state: HostState, why: Option<&str>) -> HostStatus {
        HostStatus { host: "left".into(), state, why: why.map(str::to_owned), ..HostStatus::default() }
    }

    fn stream(id: &str) -> StreamStatus {
        StreamStatus { id: id.into(), rate_hz: 30.0, captured: 9, ..StreamStatus::default() }
    }

    fn camera(name: &str, state: CameraState) -> CameraStatus {
        let streams = ["color", "depth"].map(|s| stream(&format!("{name}/{s}"))).into();
        CameraStatus { name: name.into(), state, streams, ..CameraStatus::default() }
    }

    fn mirror(stream: &str, state: MirrorState, why: Option<&str>) -> MirrorStatus {
        let why = why.map(str::to_owned);
        MirrorStatus { stream: stream.into(), state, why, coding: None, rate_hz: 12.0, frames: 5, skipped: 0 }
    }

    #[test]
    fn a_camera_has_the_streams_that_come_and_those_that_are_made_of_it() {
        let there = [camera("wrist", CameraState::Streaming), camera("other", CameraState::Streaming)];
        let mirrors = [mirror("wrist/color", MirrorState::Live, None)];
        let made = |name: &str| vec![stream(&format!("{name}/depth_refined"))];
        let seen = cameras(&host(HostState::Connected, None), &there, &mirrors, &made);
        let [wrist] = seen.as_slice() else { panic!("{seen:?}") };
        let ids: Vec<_> = wrist.streams.iter().map(|s| (s.id.as_str(), s.rate_hz, s.captured)).collect();
        assert_eq!(ids, [("wrist/color", 12.0, 9), ("wrist/depth_refined", 30.0, 9)]);
        assert_eq!((wrist.state, &wrist.message), (CameraState::Streaming, &None));
        // Nobody reads it here: its rate is that of its computer.
        let unread = [mirror("wrist/color", MirrorState::Unread, None)];
        let seen = cameras(&host(HostState::Connected, None), &there, &unread, &|_| Vec::new());
        assert_eq!((seen[0].streams.len(), seen[0].streams[0].rate_hz), (1, 30.0));
    }

    #[test]
    fn the_message_is_that_of_the_nearest_fault() {
        let quiet = [mirror("wrist/color", MirrorState::Waiting, Some("quiet"))];
        let of_stream = "wrist/color does not come here: quiet";
        let of_host = "host left: no route";
        for (state, host_state, expected, message) in [
            (CameraState::Streaming, HostState::Connected, CameraState::Stalled, of_stream),
            (CameraState::Opening, HostState::Connected, CameraState::Opening, of_stream),
            (CameraState::Failed, HostState::Connected, CameraState::Failed, "no such device"),
            (CameraState::Streaming, HostState::Absent, CameraState::Stalled, of_host),
            (CameraState::Failed, HostState::Absent, CameraState::Failed, of_host),
            (CameraState::Streaming, HostState::Refused, CameraState::Stalled, of_host),
        ] {
            let why = (host_state != HostState::Connected).then_some("no route");
            let own = (state == CameraState::Failed).then(|| "no such device".to_owned());
            let there = [CameraStatus { message: own, ..camera("wrist", state) }];
            let seen = cameras(&host(host_state, why), &there, &quiet, &|_| Vec::new());
            assert_eq!((seen[0].state, seen[0].message.as_deref()), (expected, Some(message)), "{state:?}");
        }
    }

    #[test]
    fn a_camera_that_was_never_seen_says_why() {
        let mirrors = [mirror("wrist/color", MirrorState::Waiting, Some("nobody publishes it there"))];
        let seen = cameras(&host(HostState::Connected, None), &[], &mirrors, &|_| Vec::new());
        let why = "wrist/color does not come here: nobody publishes it there";
        assert_eq!((seen[0].state, seen[0].message.as_deref()), (CameraState::Opening, Some(why)));
        let seen = cameras(&host(HostState::Absent, Some("no route")), &[], &mirrors, &|_| Vec::new());
        assert_eq!((seen[0].name.as_str(), seen[0].state), ("wrist", CameraState::Opening));
        assert_eq!((seen[0].streams.len(), seen[0].message.as_deref()), (0, Some("host left: no route")));
    }
}
