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
        (right.host.as_str(), &right.role),
        ("right", &LinkRole::Recorder("127.0.0.1:7447".parse().unwrap()))
    );
    let left = read("host = \"left\"\nrecorder = \"[fd00::1]:7447\"\ninsecure = true");
    assert_eq!(left.role, LinkRole::Camera("[fd00::1]:7447".parse().unwrap()));
    assert!(left.insecure && !right.insecure);
    assert_eq!(parse(&format!("rig = \"mount\"\n{CAMERA}")).unwrap().link, None);
}

#[test]
fn the_recorder_names_the_other_computers() {
    let read = |hosts: &str| parse(&with(&format!("host = \"right\"\nlisten = \"127.0.0.1:7447\"\n{hosts}")));
    let hosts = read(
        "[[link.hosts]]\nname = \"left\"\nssh = \"lab@10.0.0.2\"\n[[link.hosts]]\nname = \"top\"\nssh = \"top\"\nsocket = \"/run/m.sock\"\n\
         mirror = [\"wrist/color\", \"wrist/depth\"]\n\
         [[link.hosts]]\nname = \"far\"\nsocket = \"/run/far.sock\"",
    );
    let host = |name: &str, reach| HostConfig {
        name: name.parse().unwrap(),
        reach,
        mirror: Vec::new(),
        refine: None,
    };
    let ssh = |to: &str, socket: Option<&str>| Reach::Ssh {
        destination: to.to_owned(),
        socket: socket.map(Into::into),
    };
    let mirror = ["wrist/color", "wrist/depth"].map(|id| id.parse().unwrap()).into();
    let expected = [
        host("left", ssh("lab@10.0.0.2", None)),
        HostConfig { mirror, ..host("top", ssh("top", Some("/run/m.sock"))) },
        host("far", Reach::Socket("/run/far.sock".into())),
    ];
    assert_eq!(hosts.unwrap().link.unwrap().hosts, expected);
    for (text, why) in [
        ("[[link.hosts]]\nssh = \"left\"", "\"name\" is missing in [[link.hosts]]"),
        ("[[link.hosts]]\nname = \"left\"", "needs the key ssh"),
        ("[[link.hosts]]\nname = \"right\"\nssh = \"a\"", "host \"right\" is named twice"),
        ("[[link.hosts]]\nname = \"a\"\nssh = \"-oProxyCommand=x\"", "ssh must be \"user@address\""),
        ("[[link.hosts]]\nname = \"a\"\nssh = \"a b\"", "ssh must be \"user@address\""),
        ("[[link.hosts]]\nname = \"a\"\nsocket = \"m.sock\"", "must be a path that begins with /"),
        (
            "[[link.hosts]]\nname = \"a\"\nsh = \"b\"\nssh = \"b\"",
            "unknown key \"sh\" in [[link.hosts]] \"a\"",
        ),
        ("[[link.hosts]]\nname = \"a\"\nssh = \"b\"\nmirror = [\"a/b\", \"a/b\"]", "mirror names a/b twice"),
        (
            "[[link.hosts]]\nname = \"a\"\nssh = \"b\"\nmirror = [\"top\"]",
            "\"mirror\" in [[link.hosts]] \"a\" value 1 must name a stream",
        ),
        (
            "[[link.hosts]]\nname = \"a\"\nssh = \"b\"\nmirror = [\"c/color\"]\n[link.hosts.refine]",
            "[link.hosts.refine] needs a camera's color and depth in mirror",
        ),
        (
            "[[link.hosts]]\nname = \"a\"\nssh = \"b\"\nmirror = [\"c/color\", \"c/depth\", \"c/depth_refined\"]\n\
             [link.hosts.refine]",
            "c/depth_refined comes from there by mirror and from [link.hosts.refine]",
        ),
        (
            "[[link.hosts]]\nname = \"a\"\nssh = \"b\"\nmirror = [\"c/color\", \"c/depth\"]\n[link.hosts.refine]\n\
             record = false",
            "\"record\" in [link.hosts.refine] has no use",
        ),
        ("hosts = [\"left\"]", "must be written as tables, each headed [[link.hosts]]"),
    ] {
        let found = problems(&with(&format!("host = \"right\"\nlisten = \"127.0.0.1:7447\"\n{text}")));
        assert!(found.iter().any(|p| p.contains(why)), "{text}: {found:?}");
        assert_eq!(found.len(), 1, "{found:?}");
    }
    let asks = "host = \"left\"\nrecorder = \"127.0.0.1:7447\"\n[[link.hosts]]\nname = \"a\"\nssh = \"a\"";
    assert!(problems(&with(asks))[0].contains("of the computer that records the session"));
}

#[test]
fn what_is_wrong_with_a_link_is_named_with_its_cure() {
    for (text, why) in [
        ("listen = \"127.0.0.1:1\"", "\"host\" is missing in [link]"),
        ("host = \"a\"", "has neither \"recorder\" nor \"listen\""),
        ("host = \"a\"\nlisten = \"127.0.0.1:1\"\nrecorder = \"127.0.0.1:1\"", "keep one"),
        ("host = \"a\"\nlisten = \"recorder.local:1\"", "must be an IP address and a port"),
        ("host = \"A b\"\nlisten = \"127.0.0.1:1\"", "is not a valid name"),
        ("host = \"a\"\nlisten = \"127.0.0.1:1\"\nrecoder = 1", "unknown key \"recoder\""),
    ] {
        let found = problems(&with(text));
        assert!(found.iter().any(|p| p.contains(why)), "{text}: {found:?}");
        assert_eq!(found.len(), 1, "{found:?}");
    }
}
