//! The codecs in a dataset: what a camera sent is what a reader gets, and what others find in the file.

use crate::support::*;
use depthrig_bus::PixelFormat;
use depthrig_recorder::codec::{DEPTH_CODEC, DepthDecoder, DepthShape};
use depthrig_recorder::fs::MemFs;
use depthrig_recorder::{
    ColorCodec, DepthCodec, Recorder, RecorderOptions, SetDrop, Severity, VerifyOptions, verify_with,
};
use std::sync::Arc;

fn lossless() -> RecorderOptions {
    RecorderOptions { color: ColorCodec::Png, depth: DepthCodec::Rank, ..options() }
}

/// Records one image and reads it back, with the dataset verified and every image decoded.
fn there_and_back(
    format: PixelFormat,
    options: RecorderOptions,
    pad: usize,
    bytes: Vec<u8>,
) -> (MemFs, Vec<u8>) {
    let fs = MemFs::new();
    let mut session = session();
    session.streams = vec![stream("cam/any", format, 40, 12)];
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options).unwrap();
    let mut pushed = set(&session, 0);
    let header = &mut pushed.frames[0].header;
    header.payload_len = bytes.len() as u32;
    header.stride = if format == PixelFormat::Mjpeg { 0 } else { header.stride + pad as u32 };
    pushed.frames[0].pixels = Box::new(bytes);
    r.push(pushed).unwrap();
    assert!(r.finish().unwrap().complete);
    let shared: Arc<dyn depthrig_recorder::fs::Fs> = Arc::new(fs.clone());
    let report =
        verify_with(&shared, &dir(), &VerifyOptions { decode: true, ..VerifyOptions::default() }).unwrap();
    assert!(report.worst() < Some(Severity::Lost), "{:?}", report.findings);
    let got = read_all(&fs).remove(0).frames.remove(0).pixels;
    (fs, got)
}

/// The only image message: its channel's metadata and topic, its schema, its bytes.
fn message(fs: &MemFs) -> (mcap::Message<'static>, String) {
    let bytes = contents(fs, &segment(0));
    let found = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).find(|m| {
        let topic = &m.channel.topic;
        topic.ends_with("_raw") || topic.ends_with("_compressed")
    });
    let m = found.unwrap();
    let schema = m.channel.schema.as_ref().unwrap().name.clone();
    (mcap::Message { data: m.data.into_owned().into(), ..m }, schema)
}

fn rows(width_bytes: usize, pad: usize, pixels: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    for (y, row) in pixels.chunks_exact(width_bytes).enumerate() {
        out.extend_from_slice(row);
        out.extend((0..pad).map(|x| (17 * x + y + 1) as u8));
    }
    out
}

#[test]
fn depth_comes_back_bit_by_bit_with_its_padding() {
    let plain = pixels(PixelFormat::Z16, 40, 12, 3);
    for pad in [0, 2, 48, 7] {
        let bytes = rows(80, pad, &plain);
        let (fs, got) = there_and_back(PixelFormat::Z16, lossless(), pad, bytes.clone());
        assert_eq!(got, bytes, "{pad} bytes of padding");
        let (m, schema) = message(&fs);
        assert_eq!(m.channel.topic, "/rig/cam/any/depth_compressed");
        assert_eq!(
            (schema.as_str(), m.channel.metadata["codec"].as_str()),
            ("depthrig_msgs/msg/CompressedDepth", "rank")
        );
        // The message as a stranger takes it apart: stamp, frame_id, height, width, step, codec, data.
        let field = |at: usize| u32::from_le_bytes(m.data[at..at + 4].try_into().unwrap());
        let frame_id = field(12) as usize;
        let at = (16 + frame_id).next_multiple_of(4);
        let shape = DepthShape { height: field(at), width: field(at + 4), step: field(at + 8) };
        assert_eq!(shape, DepthShape { height: 12, width: 40, step: 80 + pad as u32 });
        assert_eq!(&m.data[at + 16..at + 16 + 6], DEPTH_CODEC.as_bytes());
        let data = (at + 16 + 7).next_multiple_of(4);
        assert_eq!(m.data.len(), data + 4 + field(data) as usize);
        let mut decoded = Vec::new();
        DepthDecoder::new().decode(&m.data[data + 4..], shape, &mut decoded).unwrap();
        assert_eq!(decoded, bytes);
    }
}

#[test]
fn colour_as_png_comes_back_bit_by_bit() {
    for format in [PixelFormat::Rgb8, PixelFormat::Bgr8] {
        let plain: Vec<u8> = (0..3 * 40 * 12u32).map(|i| (i * i / 7) as u8).collect();
        let (fs, got) = there_and_back(format, lossless(), 0, plain.clone());
        assert_eq!(got, plain, "{}", format.name());
        let (m, schema) = message(&fs);
        assert_eq!(
            (m.channel.topic.as_str(), schema.as_str()),
            ("/rig/cam/any/image_compressed", "sensor_msgs/msg/CompressedImage")
        );
        assert_eq!(m.channel.metadata["codec"], "png");
        let png = m.data.windows(8).position(|w| w == b"\x89PNG\r\n\x1a\n").unwrap();
        let image = image::load_from_memory(&m.data[png..]).unwrap().into_rgb8();
        let first: Vec<u8> = if format == PixelFormat::Rgb8 {
            plain[..3].to_vec()
        } else {
            vec![plain[2], plain[1], plain[0]]
        };
        assert_eq!(image.get_pixel(0, 0).0[..], first, "a PNG is RGB whatever the camera's order is");
        assert!(m.data[..png].windows(4).any(|w| w == b"png\0"), "its format says what it is");
        // Padding is not part of a PNG: it comes back as zeros, as the format page says.
        let (_, got) = there_and_back(format, lossless(), 8, rows(120, 8, &plain));
        let zeroed: Vec<u8> = plain.chunks_exact(120).flat_map(|r| [r, &[0; 8]].concat()).collect();
        assert_eq!(got, zeroed);
    }
}

#[test]
fn what_the_lossless_codecs_do_not_concern_is_stored_as_it_is() {
    for format in PixelFormat::ALL {
        if format == PixelFormat::Mjpeg || format.is_motion() {
            continue;
        }
        let bytes = pixels(format, 40, 12, 1);
        let (fs, got) = there_and_back(format, lossless(), 0, bytes.clone());
        assert_eq!(got, bytes, "{}", format.name());
        let expected = match format {
            PixelFormat::Z16 => "rank",
            PixelFormat::Rgb8 | PixelFormat::Bgr8 => "png",
            _ => "raw",
        };
        assert_eq!(message(&fs).0.channel.metadata["codec"], expected, "{}", format.name());
    }
}

/// Nothing of a camera's JPEG is touched, whichever codec colour has: what other programs find in the file is
/// what the camera sent, byte by byte.
#[test]
fn a_cameras_jpeg_is_stored_as_it_came() {
    let mut jpeg = Vec::new();
    let rgb = pixels(PixelFormat::Rgb8, 40, 12, 5);
    jpeg_encoder::Encoder::new(&mut jpeg, 77).encode(&rgb, 40, 12, jpeg_encoder::ColorType::Rgb).unwrap();
    jpeg.extend(b"a trailer that some cameras send");
    for color in [ColorCodec::Jpeg, ColorCodec::Raw, ColorCodec::Png] {
        let options = RecorderOptions { color, ..options() };
        let (fs, got) = there_and_back(PixelFormat::Mjpeg, options, 0, jpeg.clone());
        assert_eq!(got, jpeg);
        let (m, _) = message(&fs);
        assert_eq!(m.channel.metadata["codec"], "mjpeg");
        let (head, data) = m.data.split_at(m.data.len() - jpeg.len());
        assert_eq!(data, jpeg);
        assert!(head.ends_with(&(jpeg.len() as u32).to_le_bytes()), "and nothing is between length and JPEG");
    }
}

#[test]
fn slow_codecs_cost_sets_that_are_counted() {
    let fs = MemFs::new();
    let limits = RecorderOptions { workers: 1, queue_sets: 1, ..lossless() };
    let mut session = session();
    session.streams = vec![
        stream("cam/color", PixelFormat::Rgb8, 640, 480),
        stream("cam/depth", PixelFormat::Z16, 640, 480),
    ];
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), limits).unwrap();
    let mut refused = 0;
    let images = set(&session, 0);
    let bytes: Vec<Arc<[u8]>> = images.frames.iter().map(|f| f.pixels.bytes().into()).collect();
    for n in 0..60 {
        let mut next = set_of(&session, n, &[]);
        next.missing.clear();
        next.frames = (0..2)
            .map(|stream| depthrig_recorder::RecordFrame {
                stream,
                header: header(&session.streams[stream], n),
                pixels: Box::new(Arc::clone(&bytes[stream])),
            })
            .collect();
        next.spread_ns = 0;
        if let Err(e) = r.push(next) {
            assert_eq!(e.reason, SetDrop::EncoderBusy);
            refused += 1;
        }
        assert!(r.progress().encode_queue <= 1);
    }
    let summary = r.finish().unwrap();
    assert!(refused > 0 && summary.sets.balances(), "{:?}", summary.sets);
    assert_eq!(summary.sets.dropped[SetDrop::EncoderBusy as usize], refused);
}

/// The images that the Python decoder is tested with are what our encoder makes. `DEPTHRIG_BLESS=1` writes them
/// anew; their bytes may change with the zstd library, their pixels may not.
#[test]
fn the_images_of_the_python_tests_are_ours() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../python/tests/data/packed_depth.json");
    let hex = |bytes: &[u8]| bytes.iter().fold(String::new(), |all, b| all + &format!("{b:02x}"));
    let mut cases = Vec::new();
    for (name, width, height, pad, value) in [
        (
            "a slanted plane with holes",
            40,
            12,
            0,
            (|x, y| if (x + y) % 11 == 0 { 0 } else { 900 + 3 * x + 40 * y }) as fn(u32, u32) -> u32,
        ),
        ("noise, odd padding", 19, 7, 3, |x, y| (x * 7919 + y * 104_729).wrapping_mul(2_654_435_761) >> 7),
        ("one pixel", 1, 1, 0, |_, _| 65535),
        ("one value", 30, 20, 2, |_, _| 0),
        ("few values", 33, 9, 0, |x, y| 10_000 * (x * y % 4)),
    ] {
        let shape = DepthShape { width, height, step: 2 * width + pad };
        let mut bytes = Vec::new();
        for y in 0..height {
            bytes.extend((0..width).flat_map(|x| (value(x, y) as u16).to_le_bytes()));
            bytes.extend((0..pad).map(|i| (i + y + 1) as u8));
        }
        cases.push((name, shape, bytes));
    }
    if std::env::var_os("DEPTHRIG_BLESS").is_some() {
        let mut all = Vec::new();
        for (name, shape, bytes) in &cases {
            let fs = MemFs::new();
            let mut session = session();
            session.streams = vec![stream("cam/depth", PixelFormat::Z16, shape.width, shape.height)];
            let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), lossless()).unwrap();
            let mut pushed = set(&session, 0);
            let header = &mut pushed.frames[0].header;
            (header.stride, header.payload_len) = (shape.step, bytes.len() as u32);
            pushed.frames[0].pixels = Box::new(bytes.clone());
            r.push(pushed).unwrap();
            assert!(r.finish().unwrap().complete);
            all.push(serde_json::json!({
                "name": name, "width": shape.width, "height": shape.height, "step": shape.step,
                "pixels": hex(bytes), "message": hex(&message(&fs).0.data),
            }));
        }
        std::fs::write(path, serde_json::to_string_pretty(&all).unwrap() + "\n").unwrap();
    }
    let saved: Vec<serde_json::Value> = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    assert_eq!(saved.len(), cases.len());
    for (saved, (name, shape, bytes)) in saved.iter().zip(cases) {
        assert_eq!(
            (saved["name"].as_str(), saved["pixels"].as_str()),
            (Some(name), Some(hex(&bytes).as_str()))
        );
        let text = saved["message"].as_str().unwrap();
        let message: Vec<u8> =
            (0..text.len()).step_by(2).map(|i| u8::from_str_radix(&text[i..i + 2], 16).unwrap()).collect();
        // The data are the end of the message; where they begin follows from the length before them.
        let start = (16..message.len() - 4).find(|at| {
            let len = u32::from_le_bytes(message[*at..at + 4].try_into().unwrap()) as usize;
            at + 4 + len == message.len()
        });
        let mut decoded = Vec::new();
        DepthDecoder::new().decode(&message[start.unwrap() + 4..], shape, &mut decoded).unwrap();
        assert_eq!(decoded, bytes, "{name}");
    }
}
