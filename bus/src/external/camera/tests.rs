//! Decoding of the daemon's answers, valid and invalid.

use super::*;

const INSTANCE: u64 = 7;

fn run() -> ExternalAnswer {
    ExternalAnswer {
        instance: INSTANCE,
        session: 3,
        sent_ns: HostTime::now().ns(),
        want: ExternalWant::Run as u32,
        modes: 3,
        ..ExternalAnswer::default()
    }
}

fn read(answer: &ExternalAnswer, payload: &[u8]) -> Option<Wanted> {
    Wanted::decode(answer, payload, INSTANCE, 3)
}

#[test]
fn modes_that_are_to_run_are_those_with_a_one() {
    let wanted = read(&run(), &[1, 0, 1]).unwrap();
    assert_eq!((wanted.session, wanted.modes, wanted.refusal), (3, vec![0, 2], None));
    assert_eq!(read(&run(), &[2, 0, 0]).unwrap().modes, Vec::<usize>::new());
    let stop = read(&ExternalAnswer { want: 0, modes: 0, ..run() }, &[]).unwrap();
    assert_eq!((stop.session, stop.modes.len(), stop.refusal), (3, 0, None));
}

#[test]
fn answers_to_others_and_of_before_are_passed_over() {
    for change in [
        |a: &mut ExternalAnswer| a.magic[0] = b'X',
        |a: &mut ExternalAnswer| a.instance += 1,
        |a: &mut ExternalAnswer| a.sent_ns -= SILENCE.as_nanos() as i64 + 1,
    ] {
        let mut answer = run();
        change(&mut answer);
        assert!(read(&answer, &[1, 0, 1]).is_none());
    }
}

#[test]
fn answers_that_cannot_be_are_refusals_that_say_why() {
    let said = |answer: ExternalAnswer, payload: &[u8]| {
        let wanted = read(&answer, payload).unwrap();
        assert_eq!((wanted.session, wanted.modes.len()), (0, 0), "it is about no session");
        wanted.refusal.unwrap()
    };
    assert!(said(ExternalAnswer { version: 2, ..run() }, &[1, 0, 1]).contains("version 2 of the hand-shake"));
    assert!(said(ExternalAnswer { size: 1, ..run() }, &[1, 0, 1]).contains("(1 bytes)"));
    assert!(said(ExternalAnswer { want: 9, ..run() }, &[1, 0, 1]).contains("it wants 9"));
    assert_eq!(said(run(), &[1, 0]), "it answers for 3 modes in 2 bytes, and this camera has 3");
    assert!(said(ExternalAnswer { modes: 9, ..run() }, &[1, 0, 1]).contains("for 9 modes"));
}

#[test]
fn the_words_of_a_refusal_are_shown_without_what_is_no_text() {
    let mut answer = ExternalAnswer { want: 2, modes: 1, ..run() };
    answer.text[..8].copy_from_slice(b"no\x1b\xFFlens");
    assert_eq!(read(&answer, &[0]).unwrap().refusal.as_deref(), Some("no\u{FFFD}lens"));
    answer.text = [b'x'; 256];
    assert_eq!(read(&answer, &[0]).unwrap().refusal.unwrap().len(), 256);
}
