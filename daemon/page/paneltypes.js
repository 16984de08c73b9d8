/**
 * What the panels read from the API.
 *
 * @typedef {"good" | "bad" | null} Mark
 * @typedef {"whole" | "recording" | "lost" | "unfinished" | "damaged"} Health
 *
 * @typedef {Object} RecordingEntry of `GET /v1/recordings`
 * @property {string} name the folder's
 * @property {string} path
 * @property {string} scene
 * @property {string} operator
 * @property {string} rig
 * @property {number | null} started_utc_ns
 * @property {number | null} duration_ns
 * @property {number | null} sets
 * @property {number | null} sets_lost
 * @property {string[] | number | null} streams
 * @property {number | null} segments
 * @property {number | null} bytes
 * @property {Health} health
 * @property {string[]} why
 * @property {Mark} mark
 * @property {boolean} has_report
 *
 * @typedef {{directory: string, more: number, recordings: RecordingEntry[]}} RecordingList
 *
 * @typedef {"good" | "info" | "warning" | "error"} Severity
 * @typedef {{id: string, severity: Severity, camera: string | null, what: string, why: string, cure: string}} Finding
 * @typedef {{stream: string, format: string, width: number, height: number, rate_hz: number, usb_mbit_s: number}} PlannedStream
 * @typedef {{name: string, backend: string, device: string | null, port: string | null, streams: PlannedStream[],
 *   worst: Severity | null}} CameraPlan
 * @typedef {{link: string, cameras: string[], speed_mbps: number, load_mbit_s: number, plan_mbit_s: number,
 *   most_mbit_s: number}} LinkLoad
 * @typedef {{directory: string, needed_bytes_per_s: number, measured_bytes_per_s: number | null, free_bytes: number | null,
 *   minutes_left: number | null}} DiskPlan
 *
 * @typedef {Object} AttachedCamera
 * @property {string} backend
 * @property {string} model
 * @property {string | null} serial
 * @property {string} port
 * @property {number | null} usb_mbps
 * @property {string | null} controller
 * @property {string} state
 * @property {string | null} rig
 * @property {{pid: number, name: string}[]} held_by
 * @property {string[]} problems
 *
 * @typedef {Object} DoctorReport of `GET /v1/doctor`
 * @property {string} rig
 * @property {Severity} verdict
 * @property {CameraPlan[]} cameras
 * @property {LinkLoad[]} links
 * @property {DiskPlan} disk
 * @property {number} shm_needed_bytes
 * @property {number} shm_free_bytes
 * @property {Finding[]} findings
 * @property {{cameras: AttachedCamera[], unusable: string[], not_asked: string[]}} attached
 *
 * @typedef {number | boolean | string} ControlValue
 *
 * @typedef {Object} Control
 * @property {string} name
 * @property {"integer" | "boolean" | "menu"} kind
 * @property {number} [minimum]
 * @property {number} [maximum]
 * @property {number} [step]
 * @property {ControlValue | null} [default]
 * @property {{value: number, name: string}[]} [items]
 * @property {ControlValue | null} value
 * @property {ControlValue | null} in_file
 * @property {boolean} is_active
 * @property {boolean} is_read_only
 *
 * @typedef {{camera: string, problem: string | null, controls: Control[]}} CameraControls
 * @typedef {{file: string | null, cameras: CameraControls[]}} ControlList of `GET /v1/controls`
 * @typedef {{file: string | null, diff: string, fingerprint: string}} ControlChanges
 *
 * @typedef {Object} Uncertainty of projection over an image
 * @property {number} distance_m of the points that are projected
 * @property {number} pixel_mm width of a pixel at that distance
 * @property {number} columns
 * @property {(number | null)[]} sigma_px row by row; `null` where the lens shows nothing
 * @property {number} middle_px
 * @property {number} worst_px
 *
 * @typedef {{stream: string, created: string, width: number, height: number, uncertainty: Uncertainty | null}} CalibratedImage
 *   of `GET /v1/calibration`
 *
 * @typedef {Object} CameraProgress of a capture of views of a board
 * @property {string} name
 * @property {number} corners
 * @property {[number, number][]} at shares of the image's width and height
 * @property {number} views
 * @property {number[]} coverage corners in each cell, row by row
 * @property {number} coverage_columns
 * @property {number | null} worst_px
 * @property {string[]} missing
 *
 * @typedef {Object} CaptureHint
 * @property {string} text
 * @property {string | null} camera
 * @property {[number, number][] | null} outline shares of the image's width and height
 *
 * @typedef {"searching" | "moving" | "hold_still" | "known" | "unusable" | "taken"} CaptureState
 *
 * @typedef {Object} CaptureEvent of `GET /v1/calibration/events`
 * @property {number} utc_ns
 * @property {string} out
 * @property {boolean} is_finished
 * @property {string[]} refused
 * @property {{state: CaptureState, views: number, cameras: CameraProgress[], pairs: {a: string, b: string, shared: number,
 *   missing: number}[], missing: string[], hint: CaptureHint | null}} progress
 */

export {};
