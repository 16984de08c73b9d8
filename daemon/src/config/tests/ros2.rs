use super::*;

const CAMERA: &str = "[[camera]]\nname = \"a\"\nbackend = \"synthetic\"\n[[camera.stream]]\nname = \"color\"\nwidth = 64\nheight = 48\nrate_hz = 30\n";

#[test]
fn the_program_for_ros2_may_have_options_and_runs_beside_the_rig_file() {
    let with = |table: &str| parse(&format!("rig = \"a\"\n{table}{CAMERA}"));
    assert_eq!(with("").unwrap().ros2, None);
    let plain = with("[ros2]\n").unwrap().ros2.unwrap();
    assert!(plain.command.is_empty());
    assert_eq!(plain.directory, Path::new("/rigs/."));
    let command = with("[ros2]\ncommand = [\"ros\", \"--domain\", \"7\"]\n").unwrap().ros2.unwrap().command;
    assert_eq!(command, ["ros", "--domain", "7"]);
    for (table, why) in [
        ("[ros2]\ncommand = []\n", "\"command\" in [ros2] is empty"),
        ("[ros2]\ncommand = [\"\"]\n", "names no program"),
        ("[ros2]\ndomain = 7\n", "unknown key \"domain\" in [ros2]"),
        ("ros2 = true\n", "[ros2]"),
    ] {
        let found = with(table).unwrap_err().to_string();
        assert!(found.contains(why), "{table}: {found}");
    }
}
