# Included through CMAKE_PROJECT_INCLUDE when an interface package is built against the ROS wheels of the package index.
# The exported targets of those wheels list include folders of the machine that built them (/opt/python/...), and cmake
# refuses a target whose include folder does not exist. Once the project is configured, drop the folders that are not here.
# The container with its own ROS needs none of this. Needs cmake >= 3.19 (cmake_language DEFER).

function(quadid_drop_absent_includes)
  get_property(targets DIRECTORY "${CMAKE_SOURCE_DIR}" PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(listed ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT listed)
      continue()
    endif()
    set(present "")
    foreach(folder IN LISTS listed)
      # Relative folders and generator expressions are left to cmake.
      if(EXISTS "${folder}" OR NOT IS_ABSOLUTE "${folder}")
        list(APPEND present "${folder}")
      endif()
    endforeach()
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${present}")
  endforeach()
endfunction()

if(CMAKE_CURRENT_SOURCE_DIR STREQUAL CMAKE_SOURCE_DIR)
  cmake_language(DEFER CALL quadid_drop_absent_includes)
endif()
