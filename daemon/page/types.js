/**
 * The parts of `GET /v1/status` that the page shows (daemon/src/status.rs), and what goes over `/v1/live`.
 *
 * @typedef {Object} StreamStatus
 * @property {string} id `camera/stream`
 * @property {string} format
 * @property {number} width
 * @property {number} height
 * @property {number} nominal_hz
 * @property {number} rate_hz
 * @property {number | null} [samples_hz] set for an IMU, which has no images
 * @property {Record<string, number>} dropped
 * @property {number | null} last_frame_age_ms
 *
 * @typedef {"opening" | "streaming" | "stalled" | "reconnecting" | "failed" | "finished" | "stopped"} CameraState
 *
 * @typedef {Object} CameraStatus
 * @property {string} name
 * @property {CameraState} state
 * @property {string | null} message
 * @property {string[]} [warnings]
 * @property {number} reconnects
 * @property {StreamStatus[]} streams
 * @property {MountStatus | null} [mount] the calibration that it has
 *
 * @typedef {Object} MountStatus
 * @property {string} created
 * @property {number | null} age_days
 * @property {string} worth
 * @property {number} sigma_mm
 * @property {number} sigma_deg
 * @property {number} rms_px
 * @property {number} projection_worst_px
 * @property {string[]} warnings
 *
 * @typedef {Object} RecordingStatus
 * @property {boolean} active
 * @property {boolean} [closing] while it is being closed
 * @property {string} path
 * @property {string} name
 * @property {string} scene
 * @property {string} operator
 * @property {number} started_utc_ns
 * @property {number} duration_s
 * @property {number} sets
 * @property {Record<string, number>} dropped
 * @property {Record<string, number>} missing frames that recorded sets lack, by stream
 * @property {Record<string, number>} frames_dropped frames that were lost before they reached their channel, by reason
 * @property {number} bytes
 * @property {number} backlog_bytes
 * @property {string | null} error
 * @property {number} disk_free_bytes
 * @property {number | null} disk_seconds_left
 * @property {string | null} [warning]
 * @property {number} [episodes] kept ones that have ended
 * @property {number} [episodes_discarded]
 * @property {Episode | null} [episode] that runs, or the last one
 *
 * @typedef {Object} Episode
 * @property {number} number from 1
 * @property {string} task
 * @property {number} start_utc_ns
 * @property {number} [end_utc_ns] missing while it runs
 * @property {"success" | "failure"} [outcome]
 * @property {boolean} [discarded]
 *
 * @typedef {{path: string, episodes: Episode[]}} RecordingEpisodes of `GET /v1/episodes`
 *
 * @typedef {Object} SignalStatus
 * @property {string} signal its name, `DEVICE/SIGNAL`
 * @property {boolean} required
 * @property {"live" | "silent" | "missing"} state
 * @property {number | null} age_s
 * @property {number} samples
 * @property {number} missed
 *
 * @typedef {{name: string, type: "f64" | "f32" | "i64" | "bool" | "text", count?: number, unit?: string}} SignalField
 * @typedef {number | boolean | string | null} SignalElement `null` is not a number
 * @typedef {{number: number, ms: number, gap: boolean, values: (number | null)[]}} SignalPoint of each line of a plot
 *
 * @typedef {Object} SignalNews
 * @property {string} signal its name
 * @property {string | null} problem why it cannot be read
 * @property {SignalField[]} fields
 * @property {SignalElement[][]} values of each field, the first of all
 * @property {number | null} age_s
 * @property {number | null} rate_hz
 * @property {number} restarts
 * @property {SignalPoint[]} points that the page lacks
 *
 * @typedef {{signal: string, after: number}} ShownSignal `after` is the number of the last point that the page has
 * @typedef {{published: string[], signals: SignalNews[]}} SignalsNews
 *
 * @typedef {Object} LossBucket
 * @property {number} from_s after the beginning of the recording
 * @property {Record<string, number>} sets
 * @property {Record<string, number>} missing
 * @property {Record<string, number>} frames
 *
 * @typedef {Object} RecordingLosses of `GET /v1/record/losses`
 * @property {string} path
 * @property {number} duration_s
 * @property {number} bucket_s
 * @property {LossBucket[]} buckets with losses, in the order of time
 *
 * @typedef {Object} ReplayStatus
 * @property {string[]} datasets
 * @property {boolean} paused
 * @property {boolean} done
 * @property {number} position_s
 * @property {number} length_s
 * @property {number | null} set
 * @property {number} length_sets
 * @property {number} rate
 * @property {boolean} as_fast_as_possible
 * @property {boolean} loop
 * @property {string | null} waiting_for
 * @property {string[]} lost
 *
 * @typedef {Object} SetStatus
 * @property {number} nominal_hz
 * @property {number} sent
 * @property {number} incomplete
 * @property {number} spread_p50_ms
 * @property {number} [spread_p95_ms]
 * @property {{stream: string, median_ms: number, p95_ms: number}[]} [skews] from the tick of the set
 *
 * @typedef {Object} LinkStatus the clock of the session, in a rig of several computers
 * @property {string} host
 * @property {string | null} recorder
 * @property {"own" | "live" | "silent" | "unknown" | "unkeyed"} state
 *
 * @typedef {Object} HostStatus another computer of the rig
 * @property {string} host
 * @property {"connected" | "absent" | "refused"} state
 * @property {string | null} why
 * @property {number} cameras
 * @property {number} streaming
 * @property {boolean} has_clock
 * @property {CameraStatus[]} [mirrored] with the streams that come here
 *
 * @typedef {Object} HostsStatus
 * @property {HostStatus[]} hosts
 *
 * @typedef {Object} Status
 * @property {string} rig
 * @property {string} version
 * @property {number} utc_ns
 * @property {{share: number, error: string | null} | null} preparing
 * @property {CameraStatus[]} cameras
 * @property {SignalStatus[]} [signals]
 * @property {LinkStatus | null} [link]
 * @property {HostsStatus | null} [hosts]
 * @property {{pid: number | null, why: string | null} | null} [ros2] the program that publishes the rig to ROS 2
 * @property {SetStatus} sets
 * @property {RecordingStatus | null} recording
 * @property {number} cpu_cores
 * @property {ReplayStatus | null} replay
 *
 * @typedef {Object} Hello
 * @property {number} protocol
 * @property {string} version
 * @property {string} rig
 * @property {boolean} is_replay
 * @property {string | null} [dataset] that is shown instead of the live rig
 *
 * @typedef {{stream: string, width: number, rate_hz: number, measure?: boolean}} Watch
 *
 * @typedef {Object} Intrinsics of the full image, pixels; the centre of the first pixel is (0, 0)
 * @property {number} fx
 * @property {number} fy
 * @property {number} cx
 * @property {number} cy
 * @property {string} model
 * @property {number[]} coeffs
 *
 * @typedef {Object} Geometry of a stream's full images
 * @property {string} stream
 * @property {number} width
 * @property {number} height
 * @property {number} depth_unit_m
 * @property {Intrinsics} intrinsics
 * @property {[number, number, number]} translation_m of the optical frame on the mount
 * @property {[number, number, number, number]} rotation_xyzw
 *
 * @typedef {Object} Measure of a full image
 * @property {string} stream
 * @property {number} sequence
 * @property {number | null} sharpness mean square of the Laplacian of luma; `null` for depth
 * @property {number[] | null} luma 64 shares, dark first; `null` for depth
 * @property {number | null} dark share of pixels that are black
 * @property {number | null} bright share of pixels that are white
 * @property {number | null} holes share of pixels without depth; `null` for other images
 *
 * @typedef {{stream: string, x: number, y: number}} Place
 *
 * @typedef {Object} PixelAnswer
 * @property {number} id
 * @property {string} stream
 * @property {number} x
 * @property {number} y
 * @property {number | null} depth_m null where depth is missing
 * @property {[number, number, number] | null} [xyz_m]
 * @property {Place[]} seen
 *
 * @typedef {Object} Image
 * @property {"jpeg" | "depth"} kind
 * @property {number} index of its stream in the `watch` list
 * @property {number} step
 * @property {number} columns
 * @property {number} rows
 * @property {number} fullColumns
 * @property {number} fullRows
 * @property {bigint} sequence
 * @property {bigint} captureNs
 * @property {number} ageMs when it was sent
 * @property {number} unitM metres of one unit of depth
 * @property {number} watch number of the `watch` message that it answers
 * @property {ArrayBuffer} message the whole message; the payload follows the head
 */

export {};
