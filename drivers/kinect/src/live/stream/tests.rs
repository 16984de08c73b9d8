//! Measures of images, without libk4a.

use super::*;

#[test]
fn missing_and_surplus_bytes_show() {
    let rows = Unpack::Rows { wire: image_format::DEPTH16, row: 8, rows: 4 };
    let measure = |n: usize, stride| rows.measure(&vec![0; n], stride).1;
    assert_eq!(measure(32, 0), 32);
    assert_eq!(measure(32, 8), 32);
    assert_eq!(measure(31, 8), 31);
    assert_eq!(measure(1, 8), 1);
    assert_eq!(measure(0, 8), 0);
    assert_eq!(measure(33, 8), 33);
    // Rows of 12 bytes: the last one needs no padding.
    assert_eq!(measure(48, 12), 32);
    assert_eq!(measure(44, 12), 32);
    assert_eq!(measure(43, 12), 31);
    assert_eq!(measure(49, 12), 33);
    let bgra = Unpack::WithoutAlpha { row: 6, rows: 2 };
    assert_eq!(bgra.measure(&[0; 16], 8).1, 12);
    assert_eq!(bgra.measure(&[0; 8], 8).1, 6);
    assert_eq!(bgra.measure(&[0; 17], 8).1, 13);
}

#[test]
fn a_stamp_of_the_host_is_used_when_it_can_be_one() {
    let now = HostTime::from_ns(1_000_000_000_000);
    assert_eq!(arrival(999_990_000_000, now).ns(), 999_990_000_000);
    assert_eq!(arrival(0, now), now, "none was set");
    assert_eq!(arrival(1_000_000_000_001, now), now, "ahead");
    assert_eq!(arrival(900_000_000_000, now), now, "of another clock");
    assert_eq!(arrival(u64::MAX, now), now);
}
