@HEADER@
--
-- Use: SCR_ENABLE 1, copy to APM/scripts on the card, RCx_OPTION 300 (Scripting1) on a switch. Take off by hand, hover in
-- Loiter inside the envelope, switch up. Switch down, any other mode, or leaving the envelope ends it in Loiter.
-- It never arms, takes off or lands. Roll, pitch and yaw are flown as asked; the throttle movement as climb rates, which
-- the autopilot smooths: the interval of the thrust coefficient comes from hover all the same.

local SEGMENTS = { -- axis, start [s], length [s], rms [rad, or share of hover thrust], lowest and highest frequency [Hz]
@SEGMENTS@
}
local SECONDS = @SECONDS@
local LOWEST, HIGHEST, RADIUS = @LOWEST@, @HIGHEST@, @RADIUS@ -- m above home, m from where it began
local TILT, LARGEST = @ABORT_TILT@, @TILT@ -- degrees: ends it, and largest that is asked for
local BATTERY = @BATTERY@ -- per cent that must remain
local SWITCH, LOITER, GUIDED, STEP_MS = 300, 5, 4, 20
local HOLD, BRAKE, REACH, LIFT, G = 0.03, 0.22, 2.0, 0.5, 9.81

local began, home, heading = nil, nil, nil
local ready = true -- the switch was down since the last run

local function say(text)
  gcs:send_text(5, "manoeuvre: " .. text)
end

-- Multisine with Schroeder phases; the throttle's share of g is integrated to a climb rate [m/s].
local function movement(axis, t)
  local sum = 0.0
  for _, s in ipairs(SEGMENTS) do
    local at = t - s[2]
    if s[1] == axis and at >= 0.0 and at < s[3] then
      local first, last = math.ceil(s[5] * s[3] - 1e-9), math.floor(s[6] * s[3] + 1e-9)
      local lines = last - first + 1
      for k = 0, lines - 1 do
        local omega = 2.0 * math.pi * (first + k) / s[3]
        local angle = omega * at - math.pi * k * (k + 1) / lines
        local size = s[4] * math.sqrt(2.0 / lines)
        if axis == "throttle" then
          sum = sum - size * G / omega * math.cos(angle)
        else
          sum = sum + size * math.sin(angle)
        end
      end
    end
  end
  return sum
end

-- Why it may not be flown here, or nil.
local function outside()
  local position = ahrs:get_relative_position_NED_home()
  if position == nil then
    return "no position"
  end
  local height = -position:z()
  if height < LOWEST or height > HIGHEST then
    return string.format("height %.1f m", height)
  end
  if home ~= nil then
    local north, east = position:x() - home:x(), position:y() - home:y()
    if math.sqrt(north * north + east * east) > RADIUS then
      return "too far away"
    end
  end
  local tilt = math.deg(math.acos(math.cos(ahrs:get_roll()) * math.cos(ahrs:get_pitch())))
  if tilt > TILT then
    return string.format("tilt %.0f deg", tilt)
  end
  local left = battery:capacity_remaining_pct(0)
  if left == nil then
    return "no battery level: set BATT_MONITOR and BATT_CAPACITY"
  end
  if left < BATTERY then
    return string.format("battery %.0f %%", left)
  end
  return nil
end

local function finish(why)
  began, home = nil, nil
  if vehicle:get_mode() == GUIDED then
    vehicle:set_mode(LOITER)
  end
  say(why)
end

local function start()
  ready = false
  if not arming:is_armed() or not vehicle:get_likely_flying() or vehicle:get_mode() ~= LOITER then
    say("hover in Loiter first")
    return
  end
  local why = outside()
  if why ~= nil then
    say("not begun, " .. why)
    return
  end
  if not vehicle:set_mode(GUIDED) then
    say("Guided mode refused")
    return
  end
  home, heading, began = ahrs:get_relative_position_NED_home(), ahrs:get_yaw(), millis():tofloat() / 1000.0
  say("begun")
end

local function bounded(value, limit)
  return math.max(-limit, math.min(limit, value))
end

local function fly(t)
  local position, velocity = ahrs:get_relative_position_NED_home(), ahrs:get_velocity_NED()
  if position == nil or velocity == nil then
    finish("ended, no position")
    return
  end
  -- A pilot's gentle corrections keep it in place.
  local north = bounded(-HOLD * (position:x() - home:x()) - BRAKE * velocity:x(), REACH)
  local east = bounded(-HOLD * (position:y() - home:y()) - BRAKE * velocity:y(), REACH)
  local yaw = ahrs:get_yaw()
  local forward, right = math.cos(yaw) * north + math.sin(yaw) * east, math.cos(yaw) * east - math.sin(yaw) * north
  local roll = math.deg(math.atan(right / G) + movement("roll", t))
  local pitch = math.deg(math.atan(-forward / G) + movement("pitch", t))
  local wanted = math.deg(heading + movement("yaw", t)) % 360.0
  local climb = LIFT * (position:z() - home:z()) + movement("throttle", t)
  vehicle:set_target_angle_and_climbrate(bounded(roll, LARGEST), bounded(pitch, LARGEST), wanted, climb, false, 0.0)
end

local function update()
  local asked = rc:get_aux_cached(SWITCH) == 2
  ready = ready or not asked
  if began == nil then
    if asked and ready then
      start()
    end
    return update, began == nil and 200 or STEP_MS
  end
  local t = millis():tofloat() / 1000.0 - began
  local why = outside()
  if not asked then
    finish("ended by the switch")
  elseif vehicle:get_mode() ~= GUIDED then
    finish("ended by another mode")
  elseif why ~= nil then
    finish("ended, " .. why)
  elseif t >= SECONDS then
    finish("done")
  else
    fly(t)
  end
  return update, STEP_MS
end

say("loaded")
return update()
