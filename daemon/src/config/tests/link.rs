use super::*;

const CAMERA: &str = "[[camera]]\nname = \"a\"\nbackend = \"synthetic\"\n[[camera.stream]]\nname = \"color\"\nwidth = 64\nheight = 48\nrate_hz = 30\n";

fn with(link: &str) -> String {
    format!("rig = \"mount\"\n[link]\n{link}\n{CAMERA}")
}

#[test]
fn a_computer_listens_or_names_its_recorder() {
    let read = |text: &str| parse(&with(text)).unwrap().link.unwrap();
    let right = read("host = \"right\"\nlisten = \"127.0.0.1:7447\"");
    assert_eq!(
        (right.host.as_str(), right.role),
        ("right", LinkRole::Recorder("127.0.0.1:7447".parse().unwrap()))
    );
    let left = read("host = \"left\"\nrecorder = \"[fd00::1]:7447\"\ninsecure = true");
    assert_eq!(left.role, LinkRole::Camera("[fd00::1]:7447".parse().unwrap()));
    assert_eq!(parse(&format!("rig = \"mount\"\n{CAMERA}")).unwrap().link, None);
}

#[test]
fn what_is_wrong_with_a_link_is_named_with_its_cure() {
    for (text, why) in [
        ("listen = \"127.0.0.1:1\"", "\"host\" is missing in [link]"),
        ("host = \"a\"", "has neither \"recorder\" nor \"listen\""),
        ("host = \"a\"\nlisten = \"127.0.0.1:1\"\nrecorder = \"127.0.0.1:1\"", "keep one"),
        ("host = \"a\"\nlisten = \"recorder.local:1\"", "must be an IP address and a port"),
        ("host = \"a\"\nrecorder = \"10.0.0.1:1\"", "neither encrypted nor signed"),
        ("host = \"A b\"\nlisten = \"127.0.0.1:1\"", "is not a valid name"),
        ("host = \"a\"\nlisten = \"127.0.0.1:1\"\nrecoder = 1", "unknown key \"recoder\""),
    ] {
        let found = problems(&with(text));
        assert!(found.iter().any(|p| p.contains(why)), "{text}: {found:?}");
        assert_eq!(found.len(), 1, "{found:?}");
    }
}
