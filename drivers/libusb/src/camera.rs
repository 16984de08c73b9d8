//! An open USB device: its interfaces taken from the kernel and given back, its event thread, its requests.

use super::errors::{failed, not_opened};
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::uvc::descriptors::Configuration;
use depthrig_usb::{SysRoot, UsbDevice, health, holder};
use rusb::{Context, DeviceHandle, UsbContext};
use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

/// How long a control request may take. librealsense waits 100 ms, which its firmware's slow tables exceed.
pub(super) const CONTROL_TIMEOUT: Duration = Duration::from_secs(1);
/// How often the event thread looks up even if nothing wakes it.
const EVENT_WAIT: Duration = Duration::from_secs(1);
/// Pause of the event thread when libusb cannot wait for events, so that it does not spin.
const EVENT_ERROR_PAUSE: Duration = Duration::from_millis(10);

const GET_DESCRIPTOR: u8 = 6;
const CONFIGURATION: u16 = 0x0200;
/// To host, standard, device (USB 3.2, table 9-2).
const STANDARD_IN: u8 = 0x80;

/// A USB camera opened through libusb, with all its video interfaces taken from the kernel. Cloning it gives a second
/// way to the same device; the last one dropped gives the interfaces back to the kernel's driver.
#[derive(Debug, Clone)]
pub struct Camera {
    pub(super) inner: Arc<Inner>,
}

/// State that all handles of an open device share.
#[derive(Debug)]
pub(super) struct Inner {
    /// Dropped, and so closed, before the event thread ends.
    handle: DeviceHandle<Context>,
    _events: EventThread,
    device: UsbDevice,
    label: String,
    root: SysRoot,
    configuration: Configuration,
    claimed: Mutex<BTreeSet<u8>>,
}

impl Camera {
    /// Opens `device` and takes all of its video interfaces. It must not be in use: a program that streams from one of
    /// its video nodes is named, not robbed.
    ///
    /// # Errors
    /// [`ErrorKind::Busy`] naming the holder, [`ErrorKind::PermissionDenied`] with the udev rule,
    /// [`ErrorKind::NotFound`] when it is gone, [`ErrorKind::Disconnected`],
    /// [`ErrorKind::Protocol`] when its descriptor cannot be read, [`ErrorKind::Io`].
    pub fn open(root: &SysRoot, device: &UsbDevice) -> Result<Self> {
        for node in device.video_nodes() {
            let holders = holder::holders_of(root, &node.path);
            if holders.own || !holders.others.is_empty() {
                return Err(health::busy(root, &device.describe(), &node.path));
            }
        }
        let inner = Inner::open(root, device)?;
        // Streaming before control: the kernel's driver lets go of a function as a whole when its control interface
        // is taken, and until then nothing is disturbed.
        let streams = inner.configuration.streams.iter().map(|s| s.number);
        let controls = inner.configuration.controls.iter().map(|c| c.number);
        for number in streams.chain(controls) {
            inner.claim(number)?;
        }
        Ok(Self { inner: Arc::new(inner) })
    }

    /// Its configuration descriptor.
    pub fn configuration(&self) -> &Configuration {
        &self.inner.configuration
    }

    /// Model and port, for messages.
    pub fn label(&self) -> &str {
        &self.inner.label
    }

    /// The device as the kernel lists it.
    pub fn device(&self) -> &UsbDevice {
        &self.inner.device
    }
}

/// Binds the kernel's video driver to `device` again where no driver has its control interfaces: a program that used it
/// through libusb and was killed leaves them so. Says how many were bound; a device that is as it should be is not
/// opened.
///
/// # Errors
/// Those of [`Camera::open`].
pub fn give_to_kernel(root: &SysRoot, device: &UsbDevice) -> Result<usize> {
    let free = |i: &&depthrig_usb::UsbInterface| (i.class, i.subclass) == (0x0E, 1) && i.driver.is_none();
    let numbers: Vec<_> = device.interfaces.iter().filter(free).map(|i| i.number).collect();
    if numbers.is_empty() {
        return Ok(0);
    }
    let inner = Inner::open(root, device)?;
    Ok(numbers.into_iter().filter(|&n| inner.attach(n)).count())
}

impl Inner {
    fn open(root: &SysRoot, device: &UsbDevice) -> Result<Self> {
        let label = device.describe();
        let context = Context::new().map_err(|e| failed(&label, "starting libusb", e))?;
        let here = |d: &rusb::Device<Context>| {
            u16::from(d.bus_number()) == device.bus_number && u16::from(d.address()) == device.device_number
        };
        let found = context.devices().map_err(|e| failed(&label, "listing the USB", e))?.iter().find(here);
        let Some(found) = found else {
            return Err(Error::new(ErrorKind::NotFound, format!("{label} is no longer there")));
        };
        let handle = found.open().map_err(|e| not_opened(root, device, e))?;
        let events = EventThread::start(&context, &device.port)?;
        let bytes = read_configuration(&handle).map_err(|e| failed(&label, "reading its descriptor", e))?;
        let configuration = Configuration::parse(&bytes)
            .map_err(|e| Error::new(e.kind(), format!("{label}: its configuration: {e}")).with_source(e))?;
        Ok(Self {
            handle,
            _events: events,
            device: device.clone(),
            label,
            root: root.clone(),
            configuration,
            claimed: Mutex::new(BTreeSet::new()),
        })
    }

    pub(super) fn label(&self) -> &str {
        &self.label
    }

    pub(super) const fn root(&self) -> &SysRoot {
        &self.root
    }

    pub(super) const fn configuration(&self) -> &Configuration {
        &self.configuration
    }

    pub(super) const fn handle(&self) -> &DeviceHandle<Context> {
        &self.handle
    }

    /// libusb's own handle. It is open for as long as `self` is there.
    pub(super) fn raw_handle(&self) -> *mut rusb::ffi::libusb_device_handle {
        self.handle.as_raw()
    }

    /// Takes an interface, from the kernel's driver if need be.
    pub(super) fn claim(&self, number: u8) -> Result<()> {
        let mut claimed = lock(&self.claimed);
        if claimed.contains(&number) {
            return Ok(());
        }
        match self.handle.detach_kernel_driver(number) {
            // Nothing was bound to it; what `usbfs` holds for another program shows at the claim.
            Ok(()) | Err(rusb::Error::NotFound) => {}
            Err(e) => return Err(not_opened(&self.root, &self.device, e)),
        }
        self.handle.claim_interface(number).map_err(|e| not_opened(&self.root, &self.device, e))?;
        claimed.insert(number);
        Ok(())
    }

    /// Asks the kernel to bind its driver to an interface; says whether it did.
    fn attach(&self, number: u8) -> bool {
        let result = self.handle.attach_kernel_driver(number);
        match &result {
            // Gone, bound already, or no driver for it loaded: there is nothing to be done about any of them.
            Ok(()) | Err(rusb::Error::NoDevice | rusb::Error::Busy | rusb::Error::NotFound) => {}
            Err(e) => {
                tracing::warn!(camera = self.label, interface = number, %e, "the kernel's driver was not bound again");
            }
        }
        result.is_ok()
    }

    /// Gives every interface back: streaming first, control last, then the kernel's driver is bound again.
    fn give_back(&self) {
        let claimed = core::mem::take(&mut *lock(&self.claimed));
        let is_control = |n: &u8| self.configuration.controls.iter().any(|c| c.number == *n);
        let (controls, others): (Vec<_>, Vec<_>) = claimed.into_iter().partition(is_control);
        for &number in others.iter().chain(&controls) {
            match self.handle.release_interface(number) {
                Ok(()) | Err(rusb::Error::NoDevice) => {}
                Err(e) => {
                    tracing::warn!(camera = self.label, interface = number, %e, "an interface was not given back");
                }
            }
        }
        // Also where no driver was found at the start: a killed process had left it so.
        for &number in &controls {
            self.attach(number);
        }
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.give_back();
    }
}

fn read_configuration(handle: &DeviceHandle<Context>) -> rusb::Result<Vec<u8>> {
    let read = |bytes: &mut [u8]| {
        handle.read_control(STANDARD_IN, GET_DESCRIPTOR, CONFIGURATION, 0, bytes, CONTROL_TIMEOUT)
    };
    let mut head = [0; 9];
    let n = read(&mut head)?;
    let total = depthrig_driver::bytes::u16_at(head.get(..n).unwrap_or_default(), 2)
        .ok_or(rusb::Error::BadDescriptor)?;
    let mut bytes = vec![0; total.into()];
    let n = read(&mut bytes)?;
    bytes.truncate(n);
    Ok(bytes)
}

/// The thread that runs libusb's event loop for one device.
#[derive(Debug)]
struct EventThread {
    context: Context,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl EventThread {
    fn start(context: &Context, port: &str) -> Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let theirs = context.clone();
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new()
            .name(format!("usb-{port}"))
            .spawn(move || {
                while !stopped.load(Ordering::SeqCst) {
                    match theirs.handle_events(Some(EVENT_WAIT)) {
                        Ok(()) | Err(rusb::Error::Interrupted) => {}
                        Err(_) => std::thread::sleep(EVENT_ERROR_PAUSE),
                    }
                }
            })
            .map_err(|e| {
                Error::new(ErrorKind::Io, format!("no thread for the events of USB port {port}"))
                    .with_source(e)
            })?;
        Ok(Self { context: context.clone(), stop, thread: Some(thread) })
    }
}

impl Drop for EventThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        self.context.interrupt_handle_events();
        if let Some(thread) = self.thread.take() {
            // It ends within its wait, and nothing in it can panic.
            let _ = thread.join();
        }
    }
}
