//! Refuses to build with libusb linked statically: it is LGPL, and users must be able to replace it.
//!
//! `libusb1-sys` builds its own copy where it does not find the system's, says nothing, and keeps it after the system's
//! was installed.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    if std::env::var_os("DEP_USB_1.0_VENDORED").is_some() {
        println!(
            "cargo::error=libusb would be linked statically, because pkg-config did not find libusb-1.0; install it (Debian: \
             pkg-config and libusb-1.0-0-dev, or run tools/setup.sh build), then forget the copy that was built: cargo clean \
             --package libusb1-sys, and the same with --release"
        );
    }
}
