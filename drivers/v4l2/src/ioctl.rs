//! The system calls of a video node that the crate `v4l` has no safe and unpanicking form for.
//!
//! Structures and request numbers are those of `v4l` (made from the kernel's own header); each function here pairs
//! one number with its structure, which is what makes the call sound.
#![allow(unsafe_code)] // ioctl(2) takes a pointer whose type its number implies.

use core::mem;
use core::ptr;
use std::io;
use std::os::fd::RawFd;
use v4l::v4l_sys as sys;
use v4l::v4l2::vidioc;

/// Which of a node's queues (`enum v4l2_buf_type`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum QueueKind {
    Video = 1,
    Metadata = 13,
}

/// Whose memory the buffers of a queue are (`enum v4l2_memory`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum Memory {
    Mapped = 1,
    UserPointer = 2,
}

/// A buffer as the kernel describes it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Buffer {
    pub(super) index: u32,
    pub(super) bytes_used: u32,
    pub(super) length: u32,
    pub(super) flags: u32,
    pub(super) sequence: u32,
    /// The kernel's stamp, nanoseconds (of microsecond resolution).
    pub(super) stamp_ns: i64,
    /// Where to map it from; of a mapped queue alone.
    pub(super) offset: u32,
}

/// Plain C data for which all bytes zero is a value.
///
/// # Safety
/// Only for structures of the kernel's interface, which hold integers, arrays of them, raw pointers and unions of
/// those.
unsafe trait Plain: Copy {
    fn zeroed() -> Self {
        // SAFETY: the trait's own condition.
        unsafe { mem::zeroed() }
    }
}

macro_rules! plain {
    ($($t:ty),* $(,)?) => {$(
        // SAFETY: a structure of `linux/videodev2.h`, plain C data.
        unsafe impl Plain for $t {}
    )*};
}
plain!(
    sys::v4l2_capability,
    sys::v4l2_fmtdesc,
    sys::v4l2_format,
    sys::v4l2_pix_format,
    sys::v4l2_meta_format,
    sys::v4l2_requestbuffers,
    sys::v4l2_buffer,
    sys::v4l2_query_ext_ctrl,
    sys::v4l2_querymenu,
    sys::v4l2_ext_control,
    sys::v4l2_ext_controls,
    XuQuery,
    i32,
);

/// One request to an extension unit (`struct uvc_xu_control_query` of `linux/uvcvideo.h`).
#[derive(Debug, Clone, Copy)]
#[repr(C)]
struct XuQuery {
    unit: u8,
    selector: u8,
    query: u8,
    size: u16,
    data: *mut u8,
}

/// `UVCIOC_CTRL_QUERY`: read and write, type `u`, number 0x21.
const UVCIOC_CTRL_QUERY: u64 =
    (3 << 30) | ((size_of::<XuQuery>() as u64) << 16) | ((b'u' as u64) << 8) | 0x21;

/// The request number's own idea of how long its structure is.
const fn size_in(request: u64) -> usize {
    (request >> 16) as usize & 0x3FFF
}

/// # Safety
/// Pointers inside `argument` must be valid for what `request` does with them.
unsafe fn call<T: Plain>(fd: RawFd, request: u64, argument: &mut T) -> io::Result<()> {
    debug_assert_eq!(size_in(request), size_of::<T>(), "the structure is not the request's");
    if size_in(request) != size_of::<T>() {
        return Err(io::Error::other("the structure is not the request's"));
    }
    loop {
        // SAFETY: the kernel reads and writes as many bytes as the request number says, which is the size of the
        // exclusively borrowed `argument`; pointers inside it are the caller's promise.
        match unsafe { v4l::v4l2::ioctl(fd, request, ptr::from_mut(argument).cast()) } {
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            result => return result,
        }
    }
}

/// As [`call`], for structures without pointers.
fn plain_call<T: Plain>(fd: RawFd, request: u64, argument: &mut T) -> io::Result<()> {
    // SAFETY: private, and called below with structures in which the kernel follows no pointer.
    unsafe { call(fd, request, argument) }
}

/// `VIDIOC_QUERYCAP`.
pub(super) fn capability(fd: RawFd) -> io::Result<sys::v4l2_capability> {
    let mut c = Plain::zeroed();
    plain_call(fd, vidioc::VIDIOC_QUERYCAP, &mut c)?;
    Ok(c)
}

/// `VIDIOC_ENUM_FMT`: the four-character code of format number `index`; `None` past the last.
pub(super) fn enum_format(fd: RawFd, kind: QueueKind, index: u32) -> io::Result<Option<u32>> {
    let mut d = sys::v4l2_fmtdesc { index, type_: kind as u32, ..Plain::zeroed() };
    none_if_invalid(plain_call(fd, vidioc::VIDIOC_ENUM_FMT, &mut d).map(|()| d.pixelformat))
}

/// `EINVAL` is how the kernel ends a list.
fn none_if_invalid<T>(result: io::Result<T>) -> io::Result<Option<T>> {
    match result {
        Err(e) if e.kind() == io::ErrorKind::InvalidInput => Ok(None),
        other => other.map(Some),
    }
}

/// An image format as the kernel has it after `VIDIOC_S_FMT`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PixFormat {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) fourcc: u32,
    pub(super) bytes_per_line: u32,
    pub(super) size_image: u32,
}

/// `VIDIOC_S_FMT` on a capture node: asks for progressive images without row padding; the driver answers what it
/// will give.
pub(super) fn set_pix_format(fd: RawFd, width: u32, height: u32, fourcc: u32) -> io::Result<PixFormat> {
    let mut f: sys::v4l2_format = Plain::zeroed();
    f.type_ = QueueKind::Video as u32;
    f.fmt.pix = sys::v4l2_pix_format {
        width,
        height,
        pixelformat: fourcc,
        field: sys::v4l2_field_V4L2_FIELD_NONE,
        ..Plain::zeroed()
    };
    plain_call(fd, vidioc::VIDIOC_S_FMT, &mut f)?;
    // SAFETY: every bit pattern is a value of this member, and `type_` says that it is the one in use.
    let p = unsafe { f.fmt.pix };
    Ok(PixFormat {
        width: p.width,
        height: p.height,
        fourcc: p.pixelformat,
        bytes_per_line: p.bytesperline,
        size_image: p.sizeimage,
    })
}

/// `VIDIOC_S_FMT` on a metadata node: the format and the bytes of a buffer that the driver settled on.
pub(super) fn set_metadata_format(fd: RawFd, fourcc: u32) -> io::Result<(u32, u32)> {
    let mut f: sys::v4l2_format = Plain::zeroed();
    f.type_ = QueueKind::Metadata as u32;
    // Newer kernels' headers have more members than older ones.
    f.fmt.meta = sys::v4l2_meta_format { dataformat: fourcc, ..Plain::zeroed() };
    plain_call(fd, vidioc::VIDIOC_S_FMT, &mut f)?;
    // SAFETY: as in `set_pix_format`.
    let m = unsafe { f.fmt.meta };
    Ok((m.dataformat, m.buffersize))
}

/// `VIDIOC_REQBUFS`: how many buffers there are now. 0 gives all back.
pub(super) fn request_buffers(fd: RawFd, kind: QueueKind, memory: Memory, count: u32) -> io::Result<u32> {
    let mut r =
        sys::v4l2_requestbuffers { count, type_: kind as u32, memory: memory as u32, ..Plain::zeroed() };
    plain_call(fd, vidioc::VIDIOC_REQBUFS, &mut r)?;
    Ok(r.count)
}

fn describe(b: &sys::v4l2_buffer) -> Buffer {
    Buffer {
        index: b.index,
        bytes_used: b.bytesused,
        length: b.length,
        flags: b.flags,
        sequence: b.sequence,
        stamp_ns: b.timestamp.tv_sec.saturating_mul(1_000_000_000).saturating_add(b.timestamp.tv_usec * 1000),
        // SAFETY: every bit pattern is a value of this member.
        offset: unsafe { b.m.offset },
    }
}

fn blank(kind: QueueKind, memory: Memory, index: u32) -> sys::v4l2_buffer {
    sys::v4l2_buffer { index, type_: kind as u32, memory: memory as u32, ..Plain::zeroed() }
}

/// `VIDIOC_QUERYBUF`.
pub(super) fn query_buffer(fd: RawFd, kind: QueueKind, memory: Memory, index: u32) -> io::Result<Buffer> {
    let mut b = blank(kind, memory, index);
    plain_call(fd, vidioc::VIDIOC_QUERYBUF, &mut b)?;
    Ok(describe(&b))
}

/// `VIDIOC_QBUF` of a mapped buffer.
pub(super) fn queue_mapped(fd: RawFd, kind: QueueKind, index: u32) -> io::Result<()> {
    plain_call(fd, vidioc::VIDIOC_QBUF, &mut blank(kind, Memory::Mapped, index))
}

/// `VIDIOC_QBUF` of the caller's own memory.
///
/// # Safety
/// `bytes` must stay mapped, and nobody else may read or write it, until buffer `index` was dequeued, the queue was
/// switched off, or the node was closed.
pub(super) unsafe fn queue_user(fd: RawFd, index: u32, bytes: ptr::NonNull<[u8]>) -> io::Result<()> {
    let mut b = blank(QueueKind::Video, Memory::UserPointer, index);
    b.m.userptr = bytes.as_ptr().cast::<u8>() as u64;
    b.length = u32::try_from(bytes.len()).unwrap_or(u32::MAX);
    // SAFETY: the caller's promise; the kernel pins the pages of exactly this range and writes into no others.
    unsafe { call(fd, vidioc::VIDIOC_QBUF, &mut b) }
}

/// `VIDIOC_DQBUF`: the buffer that was filled first; `None` when none is.
pub(super) fn dequeue(fd: RawFd, kind: QueueKind, memory: Memory) -> io::Result<Option<Buffer>> {
    let mut b = blank(kind, memory, 0);
    match plain_call(fd, vidioc::VIDIOC_DQBUF, &mut b) {
        Ok(()) => Ok(Some(describe(&b))),
        Err(e) if e.kind() == io::ErrorKind::WouldBlock => Ok(None),
        Err(e) => Err(e),
    }
}

/// `VIDIOC_STREAMON`.
pub(super) fn stream_on(fd: RawFd, kind: QueueKind) -> io::Result<()> {
    plain_call(fd, vidioc::VIDIOC_STREAMON, &mut (kind as i32))
}

/// `VIDIOC_STREAMOFF`: all buffers are the program's again.
pub(super) fn stream_off(fd: RawFd, kind: QueueKind) -> io::Result<()> {
    plain_call(fd, vidioc::VIDIOC_STREAMOFF, &mut (kind as i32))
}

/// `VIDIOC_QUERY_EXT_CTRL`: the control after number `id`; `None` past the last. Compound controls are left out.
pub(super) fn next_control(fd: RawFd, id: u32) -> io::Result<Option<sys::v4l2_query_ext_ctrl>> {
    let mut q = sys::v4l2_query_ext_ctrl { id: id | sys::V4L2_CTRL_FLAG_NEXT_CTRL, ..Plain::zeroed() };
    none_if_invalid(plain_call(fd, vidioc::VIDIOC_QUERY_EXT_CTRL, &mut q).map(|()| q))
}

/// `VIDIOC_QUERYMENU`: the name of item `index` of a menu, or its number; `None` when the item does not exist.
pub(super) fn menu_item(fd: RawFd, id: u32, index: u32, numeric: bool) -> io::Result<Option<String>> {
    let mut m = sys::v4l2_querymenu { id, index, ..Plain::zeroed() };
    none_if_invalid(plain_call(fd, vidioc::VIDIOC_QUERYMENU, &mut m).map(|()| {
        let item = m.__bindgen_anon_1;
        if numeric {
            // SAFETY: every bit pattern is a value of this member.
            unsafe { item.value }.to_string()
        } else {
            // SAFETY: as above.
            text(&unsafe { item.name })
        }
    }))
}

/// `VIDIOC_G_EXT_CTRLS` of one control.
pub(super) fn control(fd: RawFd, id: u32, wide: bool) -> io::Result<i64> {
    let mut c = sys::v4l2_ext_control { id, ..Plain::zeroed() };
    one_control(fd, vidioc::VIDIOC_G_EXT_CTRLS, &mut c)?;
    let value = c.__bindgen_anon_1;
    // SAFETY: every bit pattern is a value of both members.
    Ok(unsafe { if wide { value.value64 } else { i64::from(value.value) } })
}

/// `VIDIOC_S_EXT_CTRLS` of one control.
pub(super) fn set_control(fd: RawFd, id: u32, wide: bool, value: i64) -> io::Result<()> {
    let mut c = sys::v4l2_ext_control { id, ..Plain::zeroed() };
    if wide {
        c.__bindgen_anon_1.value64 = value;
    } else {
        c.__bindgen_anon_1.value = value as i32;
    }
    one_control(fd, vidioc::VIDIOC_S_EXT_CTRLS, &mut c)
}

fn one_control(fd: RawFd, request: u64, c: &mut sys::v4l2_ext_control) -> io::Result<()> {
    // `which` 0: the current value, of a control of any class.
    let mut list = sys::v4l2_ext_controls { count: 1, controls: c, ..Plain::zeroed() };
    // SAFETY: `controls` points to as many controls as `count` says, exclusively borrowed. The kernel follows
    // pointers inside a control only when it is compound, and those are not enumerated.
    unsafe { call(fd, request, &mut list) }
}

/// `UVCIOC_CTRL_QUERY`: one request to an extension unit of a USB camera.
pub(super) fn unit_query(fd: RawFd, unit: u8, selector: u8, query: u8, data: &mut [u8]) -> io::Result<()> {
    let size = u16::try_from(data.len()).map_err(|_| io::Error::from(io::ErrorKind::InvalidInput))?;
    let mut q = XuQuery { unit, selector, query, size, data: data.as_mut_ptr() };
    // SAFETY: `data` points to `size` bytes, exclusively borrowed.
    unsafe { call(fd, UVCIOC_CTRL_QUERY, &mut q) }
}

/// The text in a field of the kernel's, which ends at its first zero byte.
pub(super) fn text(field: &[u8]) -> String {
    let end = field.iter().position(|b| *b == 0).unwrap_or(field.len());
    String::from_utf8_lossy(field.get(..end).unwrap_or_default()).trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_extension_unit_request_has_the_kernels_number_and_layout() {
        // linux/uvcvideo.h on 64-bit machines: _IOWR('u', 0x21, 16 bytes).
        assert_eq!(UVCIOC_CTRL_QUERY, 0xC010_7521);
        assert_eq!((mem::offset_of!(XuQuery, size), mem::offset_of!(XuQuery, data)), (4, 8));
        assert_eq!(size_in(vidioc::VIDIOC_DQBUF), size_of::<sys::v4l2_buffer>());
        assert_eq!(size_in(vidioc::VIDIOC_G_EXT_CTRLS), size_of::<sys::v4l2_ext_controls>());
    }

    #[test]
    fn text_ends_at_zero_and_survives_any_bytes() {
        assert_eq!(text(b"uvcvideo\0junk"), "uvcvideo");
        assert_eq!(text(b"full"), "full");
        assert_eq!(text(&[0xFF, b'a', 0]), "\u{FFFD}a");
        assert_eq!(text(b""), "");
    }
}
