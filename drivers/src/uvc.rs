//! What the USB Video Class says, without doing I/O: shared by the kernel path and the libusb path.

pub mod control;
