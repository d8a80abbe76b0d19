// An application in C: it sends commands at 20 Hz with the usual depth of 10, through rcl alone. Runs in pods: `driver`.
//
// Its commands say in their frame which pod sent them, as those of the other applications of a campaign.
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include <geometry_msgs/msg/twist_stamped.h>
#include <rcl/rcl.h>
#include <rcutils/error_handling.h>
#include <rosidl_runtime_c/string_functions.h>

// The wheels of ROS link the Python converters of their interfaces into rcl. No converter is called here, but the loader wants the data
// that they refer to.
void *PyExc_RuntimeError, *_Py_NoneStruct, *_Py_TrueStruct, *_Py_FalseStruct;

static const long PERIOD_NS = 50 * 1000 * 1000;

static void check(rcl_ret_t answer, const char *what) {
  if (answer != RCL_RET_OK) {
    fprintf(stderr, "%s: %s\n", what, rcutils_get_error_string().str);
    exit(1);
  }
}

int main(int argc, char *argv[]) {
  rcl_allocator_t allocator = rcl_get_default_allocator();
  rcl_init_options_t options = rcl_get_zero_initialized_init_options();
  check(rcl_init_options_init(&options, allocator), "options");
  rcl_context_t context = rcl_get_zero_initialized_context();
  check(rcl_init(argc, (const char *const *)argv, &options, &context), "context");

  rcl_node_t node = rcl_get_zero_initialized_node();
  rcl_node_options_t node_options = rcl_node_get_default_options();
  check(rcl_node_init(&node, "driver", "", &context, &node_options), "node");
  rcl_publisher_t commands = rcl_get_zero_initialized_publisher();
  rcl_publisher_options_t publisher_options = rcl_publisher_get_default_options();
  const rosidl_message_type_support_t *type = ROSIDL_GET_MSG_TYPE_SUPPORT(geometry_msgs, msg, TwistStamped);
  check(rcl_publisher_init(&commands, &node, type, "/cmd_vel", &publisher_options), "publisher");

  geometry_msgs__msg__TwistStamped *message = geometry_msgs__msg__TwistStamped__create();
  const char *pod = getenv("HOSTNAME");
  if (message == NULL || !rosidl_runtime_c__String__assign(&message->header.frame_id, pod != NULL ? pod : "")) {
    fprintf(stderr, "no memory\n");
    return 1;
  }
  message->twist.angular.z = 0.2;
  // A signal ends the process at once, as by default: nothing here is worth an orderly end.
  const struct timespec period = {0, PERIOD_NS};
  for (;;) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    message->header.stamp.sec = (int32_t)now.tv_sec;
    message->header.stamp.nanosec = (uint32_t)now.tv_nsec;
    check(rcl_publish(&commands, message, NULL), "publish");
    nanosleep(&period, NULL);
  }
}
